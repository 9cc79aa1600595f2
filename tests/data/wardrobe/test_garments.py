"""Grids of triangles and outlines."""

import numpy as np

from avatarjax.data.wardrobe import (
    garments,
)


def test_the_triangles_of_a_tube_face_outwards():
    angles, heights = np.arange(12) * np.pi / 6, np.array([1.0, 0.5, 0.0])
    ring = np.stack([np.sin(angles), np.zeros(12), np.cos(angles)], axis=1)
    points = (ring[None] + heights[:, None, None] * [0, 1, 0]).reshape(-1, 3)
    faces, uvs = garments.grid_faces(3, 12, closed=True)
    a, b, c = (points[faces[:, k]] for k in range(3))
    assert ((np.cross(b - a, c - a) * (a + b + c) * [1, 0, 1]).sum(1) > 0).all()
    assert uvs.min() == 0 and uvs.max() == 1


def test_the_outline_of_a_square():
    corners = np.array([[1.0, 1], [1, -1], [-1, -1], [-1, 1]])
    angles = np.arange(8) * np.pi / 4
    reach = garments.outline(corners, np.zeros(2), angles)
    np.testing.assert_allclose(reach, np.where(np.arange(8) % 2, np.sqrt(2), 1), atol=1e-9)
