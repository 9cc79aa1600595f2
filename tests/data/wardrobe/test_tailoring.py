"""Cutting a piece along a line, subdividing it, and spanning it over a bump."""

import numpy as np
import pytest

from avatarjax.data.wardrobe import (
    tailoring,
)
from avatarjax.data.wardrobe.garments import Piece, grid_faces


def area(piece):
    a, b, c = (piece.vertices[piece.faces[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def test_a_clipped_piece_ends_on_the_line_and_keeps_its_side(round_piece):
    half = tailoring.clip(round_piece, round_piece.vertices[:, 1] - 0.2)
    assert half.vertices[:, 1].min() == pytest.approx(0.2, abs=0.03)
    other = tailoring.clip(round_piece, 0.2 - round_piece.vertices[:, 1])
    assert area(half).sum() + area(other).sum() == pytest.approx(area(round_piece).sum(), rel=0.02)
    assert area(half).min() > 1e-4
    np.testing.assert_allclose(half.weights.sum(1), 1, atol=1e-6)


def test_subdividing_keeps_the_surface(round_piece):
    fine = tailoring.subdivide(round_piece)
    assert len(fine.faces) == 4 * len(round_piece.faces)
    assert area(fine).sum() == pytest.approx(area(round_piece).sum(), rel=1e-5)
    assert len(np.unique(fine.vertices.round(6), axis=0)) == len(fine.vertices)


def test_a_membrane_over_a_bump_is_flat():
    x, y = np.meshgrid(np.linspace(-1, 1, 15), np.linspace(1, -1, 15))
    bump = np.exp(-(x**2 + y**2) / 0.1)
    faces, uvs = grid_faces(15, 15, closed=False)
    vertices = np.stack([x, y, bump], axis=-1).reshape(-1, 3).astype(np.float32)
    sheet = Piece("sheet", vertices, faces, uvs, np.ones((225, 1), np.float32))
    over = (np.abs(x) < 0.9) & (np.abs(y) < 0.9)
    assert np.abs(tailoring.span(sheet, over.ravel()).vertices[:, 2]).max() < 0.01


def test_joined_pieces_keep_their_reach_and_braces():
    faces, uvs = grid_faces(2, 2, closed=False)
    corners = np.array([[0, 1, 0], [1, 1, 0], [0, 0, 0], [1, 0, 0]], np.float32)
    sheet = Piece("sheet", corners, faces, uvs, np.ones((4, 1), np.float32))
    cloth = Piece(
        "cloth", corners, faces, uvs, sheet.weights, np.arange(4, dtype=np.float32), np.array([[0, 3]], np.int32)
    )
    both = tailoring.join("both", [sheet, cloth], [(0.0, 0.0, 0.5, 1.0), (0.5, 0.0, 1.0, 1.0)])
    assert both.reach is not None and both.braces is not None
    np.testing.assert_array_equal(both.reach, [0, 0, 0, 0, 0, 1, 2, 3])
    np.testing.assert_array_equal(both.braces, [[4, 7]])
    np.testing.assert_array_equal(both.faces[2:], faces + 4)
    np.testing.assert_array_equal(both.uvs[2:], uvs * [0.5, 1] + [0.5, 0])
