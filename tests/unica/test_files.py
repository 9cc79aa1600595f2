import dataclasses

import jax
import numpy as np
import pytest

from avatarjax import unica
from avatarjax.io import weights
from avatarjax.unica import files


@pytest.fixture
def run_folder(avatars, tmp_path):
    """The folder of a finished ci run in which both models were trained."""
    folder = tmp_path / "runs" / "unica" / "cowgirl" / "ci"
    for name, avatar in avatars.items():
        unica.save(folder / files.file_name(name), avatar)
    return folder


def test_a_loaded_avatar_is_the_saved_one(avatar, tmp_path):
    """Equal leaves under an equal tree and config: every function of it gives identical results."""
    unica.save(tmp_path / "a.safetensors", avatar)
    loaded = unica.load(tmp_path / "a.safetensors")
    assert loaded.config == avatar.config
    assert jax.tree.structure(loaded) == jax.tree.structure(avatar)
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(avatar), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_half_precision_halves_the_file_and_changes_little(avatar, tmp_path):
    unica.save(tmp_path / "full.safetensors", avatar)
    unica.save(tmp_path / "half.safetensors", avatar, half=True, seed=3)
    full, half = (tmp_path / f"{name}.safetensors" for name in ("full", "half"))
    assert half.stat().st_size < 0.7 * full.stat().st_size
    assert weights.load_arrays(half)[1]["seed"] == 3
    loaded = unica.load(half)
    np.testing.assert_array_equal(loaded.atlas.reference, avatar.atlas.reference)
    for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(avatar), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


def test_a_run_folder_and_a_name_are_found(run_folder, monkeypatch):
    runs = run_folder.parents[2]
    for found in (unica.load(run_folder), unica.load("cowgirl", runs=runs)):
        assert found.config.dynamics == "coefficients"
    monkeypatch.chdir(runs.parent)
    assert unica.load("cowgirl").config.dynamics == "coefficients"


def test_the_model_can_be_chosen(run_folder):
    assert unica.load(run_folder, dynamics="unet").config.dynamics == "unet"


def test_the_largest_preset_wins(run_folder, avatars):
    larger = dataclasses.replace(avatars["unet"].config, turn_fraction=0.25)
    unica.save(run_folder.parent / "base" / files.file_name("unet"), avatars["unet"].replace(config=larger))
    assert unica.load("cowgirl", runs=run_folder.parents[2]).config.turn_fraction == 0.25


def test_an_unknown_name_says_the_command(tmp_path):
    with pytest.raises(ValueError, match=r"no trained avatar 'knight'.*python -m experiments\.unica --avatar knight"):
        unica.load("knight", runs=tmp_path)


def test_a_model_that_was_not_trained_is_refused(run_folder):
    (run_folder / files.file_name("unet")).unlink()
    with pytest.raises(ValueError, match="no trained avatar"):
        unica.load(run_folder, dynamics="unet")


def test_a_damaged_file_is_named(run_folder):
    path = run_folder / files.file_name("coefficients")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"avatar-coefficients\.safetensors is not a whole"):
        unica.load(run_folder)


def test_another_kind_of_file_is_named(tmp_path):
    weights.save_tree(tmp_path / "a.safetensors", {"x": np.zeros(3)})
    with pytest.raises(ValueError, match=r"a\.safetensors holds no avatar of version"):
        unica.load(tmp_path / "a.safetensors")


@pytest.mark.parametrize("missing", ["dynamics/", "standing", "pca/mean", "atlas/rows"])
def test_a_file_that_lacks_a_part_is_named(run_folder, missing):
    path = run_folder / files.file_name("unet")
    arrays, metadata = weights.load_arrays(path)
    rest = {name: value for name, value in arrays.items() if not name.startswith(missing)}
    weights.save_tree(path, weights.nest(rest), **metadata)
    with pytest.raises(ValueError, match=r"safetensors lacks parts of an avatar"):
        unica.load(path)
