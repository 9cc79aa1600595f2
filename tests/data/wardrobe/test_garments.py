"""Garment meshes: their grids, outlines and weights."""

import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data.wardrobe import accessories, garments


@pytest.fixture(scope="module")
def figure():
    body = bodies.load_body()
    vertices, rig = bodies.shape(body, {"caucasian-female-young": 1.0})
    skin = np.unique(body.faces[body.parts == body.groups.index("body")])
    return vertices[skin], body.skin_weights[skin], rig


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


def test_a_skirt_is_outside_the_legs_in_the_rest_pose(figure):
    vertices, weights, rig = figure
    arms = [i for i, n in enumerate(rig.names) if "Arm" in n or "Hand" in n]
    trunk = vertices[weights[:, arms].sum(1) < 0.3]
    piece = garments.skirt(rig, trunk, top=1.0, bottom=0.5)
    centre = np.array([0, rig.heads[0, 2]])
    angle = lambda p: np.arctan2(p[:, 0] - centre[0], p[:, 2] - centre[1])  # noqa: E731
    reach = lambda p: np.hypot(p[:, 0] - centre[0], p[:, 2] - centre[1])  # noqa: E731
    legs = trunk[(trunk[:, 1] > 0.52) & (trunk[:, 1] < 0.98)]
    cloth = piece.vertices
    for point, at, far in zip(legs[::40], angle(legs)[::40], reach(legs)[::40], strict=True):
        turned = np.abs((angle(cloth) - at + np.pi) % (2 * np.pi) - np.pi)
        near = np.argmin(turned * 0.3 + np.abs(cloth[:, 1] - point[1]))
        assert reach(cloth)[near] > far - 0.005
    assert (piece.reach[:66] == 0).all() and (piece.reach[-66:] > 0.5).all()


@pytest.mark.parametrize("side", ["Left", "Right"])
def test_a_boot_moves_with_its_own_leg(figure, side):
    vertices, weights, rig = figure
    boot = accessories.boot(rig, side, vertices, weights, top=0.3)
    own = [i for i, n in enumerate(rig.names) if n in (f"{side}Leg", f"{side}Foot", f"{side}ToeBase")]
    assert boot.weights[:, own].sum(1).min() > 0.98
    assert boot.vertices[:, 1].min() > -0.02
