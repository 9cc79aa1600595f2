"""A dataset made from recorded meshes, as if they were somebody else's."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap
from avatarjax.data import MeshSequence, building, dataset
from avatarjax.io import exr, weights


@pytest.fixture(scope="module")
def meshes(tiny_folder):
    """Six clips of the tiny dataset as plain meshes in the world."""
    clips = [weights.load_arrays(tiny_folder / "clips" / f"train-{k:03d}.safetensors")[0] for k in range(6)]
    figure = weights.load_arrays(tiny_folder / "avatar.safetensors")[0]
    vertices = [c["vertices"][::3].astype(np.float32) + c["roots"][::3, None] for c in clips]
    return MeshSequence(
        vertices=np.concatenate(vertices),
        faces=figure["faces"],
        uvs=figure["uvs"],
        texture=exr.read_png(tiny_folder / "texture.png"),
        actions=np.concatenate([c["actions"][::3] for c in clips]),
        action_names=("idle", "forward", "backward", "left", "right"),
        sequence=np.repeat(np.arange(6, dtype=np.int32), 20),
        sequence_names=tuple("abcdef"),
        roots=np.concatenate([c["roots"][::3] for c in clips]),
        joints=None,
        source="walks",
    )


@pytest.fixture(scope="module")
def folder(meshes, tiny_spec, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "data"
    spec = dataclasses.replace(tiny_spec, source=building.describe(meshes))
    building.build(folder, spec, meshes, progress=False)
    return folder


def test_recorded_meshes_become_a_dataset(folder, meshes):
    data = dataset.load(folder)
    assert data.train.actions.shape == (100,) and data.held_out.actions.shape == (20,)
    np.testing.assert_array_equal(data.held_out.actions, meshes.actions[80:100])
    assert data.train_images.rgba.shape == (2, 2, 32, 32, 4)
    assert (data.train_images.rgba[..., 3] == 255).mean() > 0.02


def test_texels_lie_on_the_recorded_surface(folder, meshes):
    data = dataset.load(folder)
    world = np.asarray(data.train.texels[7]) + np.asarray(data.train.roots[7])
    expected = np.asarray(posmap.encode(data.atlas, jnp.asarray(meshes.vertices[7])))
    np.testing.assert_allclose(world, expected, atol=1e-5)


def test_a_single_sequence_is_cut_for_the_held_out_part(meshes, tiny_spec, tmp_path):
    one = dataclasses.replace(meshes, sequence=np.zeros(120, np.int32), sequence_names=("all",), texture=None)
    building.build(tmp_path, dataclasses.replace(tiny_spec, source=building.describe(one)), one, progress=False)
    data = dataset.load(tmp_path)
    assert len(data.train.actions) == 96 and len(data.held_out.actions) == 24


def test_other_meshes_are_another_source(meshes):
    moved = dataclasses.replace(meshes, vertices=meshes.vertices + np.float32(0.01))
    assert building.describe(moved) != building.describe(meshes)


def test_a_spec_of_another_source_is_refused(meshes, tiny_spec, tmp_path):
    with pytest.raises(ValueError, match=r"building\.describe"):
        building.build(tmp_path, tiny_spec, meshes, progress=False)


def test_a_sequence_without_a_group_is_refused(meshes, tiny_spec, tmp_path):
    short = np.concatenate([np.zeros(117, np.int32), np.ones(3, np.int32)])
    cut = dataclasses.replace(meshes, sequence=short, sequence_names=("a", "b"))
    with pytest.raises(ValueError, match="has 3 frames, a group of maps needs four"):
        building.build(tmp_path, dataclasses.replace(tiny_spec, source=building.describe(cut)), cut, progress=False)
