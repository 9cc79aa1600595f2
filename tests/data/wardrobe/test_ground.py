"""Points are held clear of surfaces."""

import numpy as np

from avatarjax.data.wardrobe.ground import Ground


def test_points_are_held_clear(round_piece):
    ground = Ground.of([round_piece])
    points = np.random.default_rng(0).normal(size=(50, 3))
    points *= 0.98 / np.linalg.norm(points, axis=1, keepdims=True)
    held = ground.hold_clear(points, 0.02)
    assert ground.clearance(held)[0].min() > 0.015
    far = points * 3
    np.testing.assert_array_equal(ground.hold_clear(far, 0.02), far)
