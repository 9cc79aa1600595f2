"""Points along lines, and ropes around them."""

import numpy as np

from avatarjax.data.wardrobe import (
    paths,
)


def test_points_along_a_path_are_even():
    path = paths.through(np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0]]), 30)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.02)


def test_a_closed_rope_lies_around_its_path():
    angles = np.arange(40) * 2 * np.pi / 40
    path = np.stack([np.sin(angles), np.zeros(40), np.cos(angles)], axis=1)
    points = paths.rope(path, np.full(40, 0.1), 8, closed=True)
    np.testing.assert_allclose(np.linalg.norm(points - path[:, None], axis=-1), 0.1, atol=1e-9)
    np.testing.assert_allclose(points[:, 0], 1.1 * path, atol=1e-9)
