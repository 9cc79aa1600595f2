"""What drapes over a ball, and how its mesh is evened."""

import numpy as np

from avatarjax.data.wardrobe import (
    drape,
    paths,
)
from avatarjax.data.wardrobe.ground import Ground
from tests.data.wardrobe.shapes import ball


def test_a_sheet_falls_along_a_ball_and_then_straight_down():
    points, _ = ball()
    lie_on = Ground.at((0.2 * points, points))
    angles = np.linspace(-0.5, 0.5, 9)
    start = np.stack([0.1 * np.sin(angles), np.full(9, 0.19), 0.1 * np.cos(angles)], axis=1)
    rows = drape.fall(
        start, np.full(9, 0.6), 31, lie_on, pull=lambda p, gone: np.tile([0.0, -1.0, 0.0], (len(p), 1)), gap=0.01
    )
    np.testing.assert_allclose(np.linalg.norm(np.diff(rows, axis=0), axis=-1)[:, 4], 0.02, atol=0.006)
    assert np.linalg.norm(rows[4:], axis=-1).min() > 0.207
    assert np.abs(rows[6] - rows[5])[:, 2].min() > 0.003  # around the ball
    np.testing.assert_allclose((rows[-1] - rows[-5])[4], [0, -0.08, 0], atol=3e-3)


def test_an_even_sheet_has_even_columns():
    rows = np.zeros((12, 5, 3))
    rows[..., 0] = np.linspace(0, 1, 5)
    rows[..., 1] = -(np.linspace(0, 1, 12)[:, None] ** 2)
    steps = np.diff(paths.walked(drape.even_grid(rows)), axis=0)
    np.testing.assert_allclose(steps, 1 / 11, atol=1e-6)


def test_rays_leave_a_ball_at_its_radius():
    points, _ = ball()
    out = drape.outward(0.1 * points + [0, 1, 0], np.array([0.0, 1, 0]), points[::50])
    np.testing.assert_allclose(out, 0.1 * points[::50] + [0, 1, 0], atol=1e-3)
