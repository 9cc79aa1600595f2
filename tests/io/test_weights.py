"""Pytrees in safetensors files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import Gaussians
from avatarjax.io.weights import load_arrays, load_tree, save_tree


def assert_same_tree(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    "tree",
    [
        {"dense": {"kernel": jnp.ones((2, 3)), "bias": jnp.zeros(3, jnp.bfloat16)}, "step": jnp.int32(7)},
        {"layers": [jnp.arange(3), jnp.zeros((0, 4))], "mask": jnp.asarray([True, False])},
        Gaussians(jnp.ones((2, 3)), jnp.ones((2, 3)), jnp.ones((2, 4)), jnp.ones(2), jnp.ones((2, 3))),
    ],
    ids=["dict", "list", "Gaussians"],
)
def test_round_trip(tmp_path, tree):
    save_tree(tmp_path / "a.safetensors", tree)
    assert_same_tree(load_tree(tmp_path / "a.safetensors", tree)[0], tree)


def test_transposed_array_keeps_its_values(tmp_path):
    tree = {"kernel": np.arange(6.0, dtype=np.float32).reshape(2, 3).T}
    save_tree(tmp_path / "a.safetensors", tree)
    np.testing.assert_array_equal(load_tree(tmp_path / "a.safetensors", tree)[0]["kernel"], tree["kernel"])


def test_prng_keys_continue_the_same_stream(tmp_path, key):
    tree = {"key": key, "keys": jax.random.split(key, 3)}
    save_tree(tmp_path / "a.safetensors", tree)
    assert_same_tree(load_tree(tmp_path / "a.safetensors", tree)[0], tree)


def test_metadata_comes_back(tmp_path):
    save_tree(tmp_path / "a.safetensors", {"x": jnp.ones(1)}, preset="small", steps=[1, 2])
    assert load_arrays(tmp_path / "a.safetensors")[1] == {"preset": "small", "steps": [1, 2]}


def test_template_may_be_abstract(tmp_path):
    save_tree(tmp_path / "a.safetensors", {"x": jnp.ones((2, 3))})
    tree, _ = load_tree(tmp_path / "a.safetensors", {"x": jax.ShapeDtypeStruct((2, 3), jnp.float32)})
    np.testing.assert_array_equal(tree["x"], np.ones((2, 3)))


def test_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(ValueError, match=r"nothing\.safetensors does not exist"):
        load_arrays(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("length", [0, 4, 40, -1])
def test_corrupt_file_is_refused_by_name(tmp_path, length):
    path = tmp_path / "a.safetensors"
    save_tree(path, {"x": jnp.ones(100)})
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(ValueError, match=r"a\.safetensors is not a whole safetensors file"):
        load_arrays(path)


@pytest.mark.parametrize("template", [{"x": jnp.ones(3)}, {"y": jnp.ones(2)}], ids=["shape", "name"])
def test_file_of_another_configuration_is_refused(tmp_path, template):
    save_tree(tmp_path / "a.safetensors", {"x": jnp.ones(2)})
    with pytest.raises(ValueError, match="does not fit this configuration"):
        load_tree(tmp_path / "a.safetensors", template)
