"""Robes: what drapes over a ball, hangs around an arm or is spanned over a bump is where it should be."""

import numpy as np
import pytest

from avatarjax.data import body as bodies
from avatarjax.data.wardrobe import assembly, bodice, cords, drape, robes, visibility
from avatarjax.data.wardrobe.garments import Piece, grid_faces


@pytest.fixture(scope="module")
def woman():
    body = bodies.load_body()
    bare, rig = bodies.shape(body, {"asian-female-young": 1.0})
    skin = bodice.visible_skin(body, bare)
    return rig, skin, drape.ground((skin.vertices, assembly.vertex_normals(skin.vertices, skin.faces)))


def ball(rows=30, columns=60):
    polar, angles = np.meshgrid(np.linspace(0.01, np.pi - 0.01, rows), np.arange(columns) * 2 * np.pi / columns)
    polar, angles = polar.T, angles.T
    n = np.stack([np.sin(polar) * np.sin(angles), np.cos(polar), np.sin(polar) * np.cos(angles)], axis=-1)
    return n.reshape(-1, 3), grid_faces(rows, columns, closed=True)[0]


def test_a_sheet_falls_along_a_ball_and_then_straight_down():
    points, _ = ball()
    lie_on = drape.ground((0.2 * points, points))
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
    steps = np.diff(drape.walked(drape.even_grid(rows)), axis=0)
    np.testing.assert_allclose(steps, 1 / 11, atol=1e-6)


def test_rays_leave_a_ball_at_its_radius():
    points, _ = ball()
    out = drape.outward(0.1 * points + [0, 1, 0], np.array([0.0, 1, 0]), points[::50])
    np.testing.assert_allclose(out, 0.1 * points[::50] + [0, 1, 0], atol=1e-3)


def test_a_sleeve_is_sewn_to_the_arm_hangs_below_the_wrist_and_faces_outwards(woman):
    rig, skin, lie_on = woman
    for side, sign in (("Left", 1), ("Right", -1)):
        sleeve = robes.sleeve_bell(rig, side, lie_on, skin.weights, start=0.08, drop=0.2, columns=36)
        assert sleeve.reach is not None
        rings = sleeve.vertices.reshape(-1, 36, 3)
        assert np.abs(lie_on.height(rings[0])[0]).max() < 0.006
        assert (sleeve.reach.reshape(-1, 36)[:2] == 0).all() and sleeve.reach.max() > 0.2
        wrist = rig.heads[rig.index(side + "Hand")]
        assert rings[-1, :, 1].min() < wrist[1] - 0.15
        assert (sign * sleeve.vertices[:, 0]).min() > 0
        normals = assembly.vertex_normals(sleeve.vertices, sleeve.faces).reshape(rings.shape)
        assert ((rings - rings.mean(1, keepdims=True)) * normals).sum(-1).mean() > 0
        of_arm = [rig.index(n) for n in rig.names if n.startswith(side) and ("Arm" in n or "Hand" in n)]
        assert sleeve.weights[:, of_arm].sum(1).min() > 0.6


def test_a_membrane_over_a_bump_is_flat():
    x, y = np.meshgrid(np.linspace(-1, 1, 15), np.linspace(1, -1, 15))
    bump = np.exp(-(x**2 + y**2) / 0.1)
    faces, uvs = grid_faces(15, 15, closed=False)
    vertices = np.stack([x, y, bump], axis=-1).reshape(-1, 3).astype(np.float32)
    sheet = Piece("sheet", vertices, faces, uvs, np.ones((225, 1), np.float32))
    over = (np.abs(x) < 0.9) & (np.abs(y) < 0.9)
    assert np.abs(bodice.span(sheet, over.ravel()).vertices[:, 2]).max() < 0.01


def test_a_ball_inside_a_ball_is_not_seen():
    points, faces = ball()
    vertices = np.concatenate([points, 0.5 * points]).astype(np.float32)
    both = np.concatenate([faces, faces + len(points)]).astype(np.int32)
    seen = visibility.seen(vertices, both, np.concatenate([points, points]).astype(np.float32))
    assert seen[: len(points)].all()
    # The holes at the poles let in a few rays.
    assert seen[len(points) :].mean() < 0.1


def test_a_rope_end_is_one_more_strip_of_the_cloth_it_hangs_on(woman):
    rig, skin, _ = woman
    skirt = robes.long_skirt(rig, skin.vertices[np.abs(skin.vertices[:, 0]) < 0.2], top=0.95, bottom=0.1)
    path = np.stack([np.full(20, 0.03), np.linspace(0.95, 0.55, 20), np.linspace(0.2, 0.3, 20)], axis=1)
    tied = cords.hang_rope(skirt, path)
    assert tied.braces is not None and tied.reach is not None
    assert len(tied.vertices) == len(skirt.vertices) + 20 * 6
    rope = np.arange(len(skirt.vertices), len(tied.vertices))
    assert set(rope) <= set(np.unique(tied.braces))
    assert tied.reach[rope].min() == 0 and tied.reach[rope].max() > 0.4
    np.testing.assert_allclose(tied.weights.sum(1), 1, atol=1e-5)
