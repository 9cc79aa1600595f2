"""The shipped body: size, shape targets, symmetry, and that the asset can be built again bit for bit."""

import os
from pathlib import Path

import numpy as np
import pytest

from avatarjax.data import body as bodies

FEMALE = {"caucasian-female-young": 1.0}


@pytest.fixture(scope="module")
def body():
    return bodies.load_body()


def test_the_asset_is_small():
    assert bodies.ASSET.stat().st_size < 2_500_000


def test_skin_weights_sum_to_one_over_at_most_four_bones(body):
    np.testing.assert_allclose(body.skin_weights.sum(1), 1, atol=1e-6)
    assert (body.skin_weights > 0).sum(1).max() <= 4


@pytest.mark.parametrize("macro", [{}, FEMALE, {"caucasian-male-old": 1.0}], ids=["base", "female", "old"])
def test_the_joints_are_mirror_images(body, macro):
    _, rig = bodies.shape(body, macro)
    left = [i for i, n in enumerate(rig.names) if n.startswith("Left")]
    right = [rig.index(rig.names[i].replace("Left", "Right")) for i in left]
    np.testing.assert_allclose(rig.heads[left] * [-1, 1, 1], rig.heads[right], atol=2e-3)


def test_parents_come_before_their_children(body):
    assert all(p < i for i, p in enumerate(body.parents))
    assert body.parents[0] == -1 and body.names[0] == "Hips"


def test_a_shaped_body_stands_on_the_ground(body):
    vertices, rig = bodies.shape(body, FEMALE)
    skin = vertices[np.unique(body.faces[body.parts == body.groups.index("body")])]
    assert skin[:, 1].min() == 0
    assert 1.5 < vertices[:, 1].max() < 1.75
    assert rig.soles[..., 1].max() < 0.03


def test_joints_move_linearly_with_the_targets_as_the_vertices_do(body):
    _, none = bodies.shape(body, {})
    _, half = bodies.shape(body, {"caucasian-male-old": 0.5})
    _, full = bodies.shape(body, {"caucasian-male-old": 1.0})
    lengths = [np.linalg.norm(r.tails[0] - r.heads[0]) for r in (none, half, full)]
    np.testing.assert_allclose(half.heads[:, 2] * 2, none.heads[:, 2] + full.heads[:, 2], atol=1e-6)
    assert len(set(lengths)) == 3


def test_faces_and_uvs_are_in_range(body):
    assert body.faces.min() == 0 and body.faces.max() == len(body.vertices) - 1
    assert body.uv_faces.max() < len(body.uvs)
    assert body.uvs.min() >= 0 and body.uvs.max() <= 1


def test_an_unknown_target_is_refused(body):
    with pytest.raises(ValueError, match="martian"):
        bodies.shape(body, {"martian": 1.0})


def test_an_unknown_bone_is_refused(body):
    with pytest.raises(ValueError, match="Tail"):
        bodies.shape(body, {})[1].index("Tail")


def test_the_asset_is_reproducible(tmp_path):
    raw = os.environ.get("AVATARJAX_RAW_ASSETS")
    if not raw:
        pytest.skip("AVATARJAX_RAW_ASSETS does not name a folder with mpfb2/ and dcl_emotes/")
    from experiments import assets

    out = tmp_path / "human.safetensors"
    assets.main(assets.Config(mpfb2=Path(raw) / "mpfb2", emotes=Path(raw) / "dcl_emotes", out=out))
    assert out.read_bytes() == bodies.ASSET.read_bytes()


@pytest.mark.parametrize("macro", [FEMALE, {"caucasian-male-old": 0.25, "caucasian-male-young": 0.75}])
def test_a_shape_is_found_again_by_its_joints_on_any_ground(body, macro):
    _, rig = bodies.shape(body, macro)
    found = bodies.fit(body, rig.heads + np.array([0, 0.3, 0], np.float32))
    assert all(abs(weight - macro.get(name, 0)) < 1e-3 for name, weight in found.items())
    assert set(macro) <= set(found)


def test_joints_of_another_number_are_no_body(body):
    with pytest.raises(ValueError, match=r"\(3, 3\) joints: the body has \d+, Hips"):
        bodies.fit(body, np.zeros((3, 3)))
