"""Cutting a piece along a line, subdividing it, and holding points clear of it."""

import numpy as np
import pytest

from avatarjax.data.wardrobe import garments, tailoring


@pytest.fixture(scope="module")
def ball():
    tilt, turn = np.linspace(0.05, np.pi - 0.05, 12), np.arange(18) * np.pi / 9
    points = np.stack(
        [
            np.sin(tilt)[:, None] * np.sin(turn),
            np.broadcast_to(np.cos(tilt)[:, None], (12, 18)),
            np.sin(tilt)[:, None] * np.cos(turn),
        ],
        axis=-1,
    )
    faces, uvs = garments.grid_faces(12, 18, closed=True)
    weights = np.stack([0.5 + 0.5 * points[..., 1].ravel(), 0.5 - 0.5 * points[..., 1].ravel()], axis=1)
    return garments.Piece("ball", points.reshape(-1, 3).astype(np.float32), faces, uvs, weights.astype(np.float32))


def area(piece):
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def test_a_clipped_piece_ends_on_the_line_and_keeps_its_side(ball):
    half = tailoring.clip(ball, ball.vertices[:, 1] - 0.2)
    assert half.vertices[:, 1].min() == pytest.approx(0.2, abs=0.03)
    other = tailoring.clip(ball, 0.2 - ball.vertices[:, 1])
    assert area(half).sum() + area(other).sum() == pytest.approx(area(ball).sum(), rel=0.02)
    assert area(half).min() > 1e-4
    np.testing.assert_allclose(half.weights.sum(1), 1, atol=1e-6)


def test_subdividing_keeps_the_surface(ball):
    fine = tailoring.subdivide(ball)
    assert len(fine.faces) == 4 * len(ball.faces)
    assert area(fine).sum() == pytest.approx(area(ball).sum(), rel=1e-5)
    assert len(np.unique(fine.vertices.round(6), axis=0)) == len(fine.vertices)


def test_points_are_held_clear(ball):
    ground = tailoring.Ground.of([ball])
    points = np.random.default_rng(0).normal(size=(50, 3))
    points *= 0.98 / np.linalg.norm(points, axis=1, keepdims=True)
    held = ground.hold_clear(points, 0.02)
    assert ground.clearance(held)[0].min() > 0.015
    far = points * 3
    np.testing.assert_array_equal(ground.hold_clear(far, 0.02), far)
