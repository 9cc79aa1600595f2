"""Axes and units: every preset brings a standing figure upright, ahead and to metres; contradictions name the fix."""

import import_figures as figures
import numpy as np
import pytest

from avatarjax.data import body
from avatarjax.data.importers import axes


@pytest.mark.parametrize("preset", axes.PRESETS)
def test_presets_are_rotations_with_one_reflection_for_left_hands(preset):
    m = axes.matrix(*axes.PRESETS[preset])
    np.testing.assert_allclose(m @ m.T, np.eye(3))
    assert np.linalg.det(m) == pytest.approx(-1 if axes.PRESETS[preset][2] == "left" else 1)


def test_presets_send_the_named_directions_to_ours():
    x, y, z = np.eye(3)
    np.testing.assert_allclose(axes.matrix("z", "-y") @ np.stack([z, -y, x]).T, np.stack([y, z, x]).T)
    # Unreal: x ahead, y to the right, z up.
    np.testing.assert_allclose(axes.matrix(*axes.PRESETS["unreal"]) @ np.stack([x, -y, z]).T, np.stack([z, x, y]).T)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
@pytest.mark.parametrize("spread", [1.0, 3.3], ids=["arms down", "arms as wide as tall"])
def test_up_is_found(up, spread):
    vertices, _, _ = figures.figure()
    arms = np.abs(vertices[:, 0]) > 0.25
    vertices[arms, 0] = np.sign(vertices[arms, 0]) * (0.25 + (np.abs(vertices[arms, 0]) - 0.25) * (spread - 1) * 4)
    turned = vertices @ axes.matrix(up)
    ours = turned @ axes.choose(turned).T
    np.testing.assert_allclose(ours[:, 1], vertices[:, 1], atol=1e-5)


@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_up_is_found_of_a_real_body(up):
    vertices, _ = body.shape(body.load_body(), {})
    turned = vertices @ axes.matrix(up)
    np.testing.assert_allclose((turned @ axes.choose(turned).T)[:, 1], vertices[:, 1], atol=1e-5)


def test_a_wrong_up_axis_names_the_right_one():
    vertices, _, _ = figures.figure()
    with pytest.raises(ValueError, match=r"stands along y.*pass up='y'"):
        axes.choose(vertices, up="z")
    with pytest.raises(ValueError, match=r"stands along y"):
        axes.choose(vertices, axes="blender")
    with pytest.raises(ValueError, match=r"on its head: pass up='y'"):
        axes.choose(vertices, up="-y")
    np.testing.assert_allclose(axes.choose(vertices, up="z", check=False), axes.matrix("z"))


def test_unknown_or_contradictory_axes_are_refused():
    vertices, _, _ = figures.figure()
    for arguments, match in (
        ({"axes": "maya"}, "choose one of gltf, blender, unreal"),
        ({"axes": "blender", "up": "z"}, "pass either"),
        ({"up": "w"}, "is no axis"),
        ({"up": "y", "forward": "-y"}, "cannot face"),
        ({"up": "y", "handedness": "both"}, "'left' or 'right'"),
    ):
        with pytest.raises(ValueError, match=match):
            axes.choose(vertices, **arguments)


def test_units_by_height():
    assert [axes.metres(h) for h in (1.7, 170.0, 1700.0)] == [1.0, 0.01, 0.001]
    assert axes.metres(66.9, 0.0254) == 0.0254
    with pytest.raises(ValueError, match="in none of m, cm, mm"):
        axes.metres(12.0)
    with pytest.raises(ValueError, match=r"170 m tall.*pass unit='cm'"):
        axes.metres(170.0, "m")
    assert axes.metres(170.0, "m", check=False) == 1.0
    with pytest.raises(ValueError, match="unit='feet' is unknown"):
        axes.metres(5.6, "feet")


def test_inward_meshes_are_turned():
    vertices, faces, uvs = figures.figure()
    turned, moved = axes.outward(vertices, faces[:, ::-1].copy(), uvs[:, ::-1].copy())
    np.testing.assert_array_equal(turned, faces)
    np.testing.assert_array_equal(moved, uvs)
    assert axes.outward(vertices, faces, uvs)[0] is faces
