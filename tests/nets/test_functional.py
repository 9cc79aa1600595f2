"""Networks as pure functions of plain nested dicts of arrays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from avatarjax.io import weights
from avatarjax.nets import functional
from tests.parameters import random_params


@dataclasses.dataclass(frozen=True)
class TinyConfig:
    width: int = 4
    depth: int = 3


class Tiny(nnx.Module):
    """Some linear layers in a list, as the real networks have them."""

    def __init__(self, config, *, rngs):
        self.layers = nnx.List([nnx.Linear(config.width, config.width, rngs=rngs) for _ in range(config.depth)])
        self.leave = nnx.Linear(config.width, 2, use_bias=False, rngs=rngs)

    def __call__(self, x):
        for layer in self.layers:
            x = jnp.tanh(layer(x))
        return self.leave(x)


CONFIG = TinyConfig()


def apply(params, x):
    return functional.bind(Tiny, CONFIG, params)(x)


def by_hand(params, x):
    for k in range(CONFIG.depth):
        layer = params["layers"][k]
        x = np.tanh(x @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"], np.float64))
    return x @ np.asarray(params["leave"]["kernel"], np.float64)


@pytest.fixture(scope="module")
def params():
    return random_params(Tiny, CONFIG)


@pytest.fixture(scope="module")
def x():
    return jax.random.normal(jax.random.key(4), (5, CONFIG.width))


def test_parameters_are_plain_dicts_of_arrays():
    def walk(node):
        if isinstance(node, dict):
            assert type(node) is dict
            for child in node.values():
                walk(child)
        else:
            assert isinstance(node, jax.Array) and not isinstance(node, nnx.Variable)

    walk(functional.init(Tiny, CONFIG, jax.random.key(0)))


def test_the_same_key_gives_the_same_parameters_and_another_key_others(key):
    a, b, c = (functional.init(Tiny, CONFIG, k) for k in (key, key, jax.random.key(1)))
    assert all(jax.tree.leaves(jax.tree.map(lambda p, q: bool((p == q).all()), a, b)))
    assert not (a["leave"]["kernel"] == c["leave"]["kernel"]).any()


def test_shapes_are_those_of_init_without_arrays(params):
    shapes = functional.shapes(Tiny, CONFIG)
    assert all(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in jax.tree.leaves(shapes))
    assert jax.tree.map(lambda s: (s.shape, s.dtype), shapes) == jax.tree.map(lambda p: (p.shape, p.dtype), params)


def test_count_adds_every_entry(params):
    expected = 3 * (4 * 4 + 4) + 4 * 2
    assert functional.count(params) == expected
    assert functional.count(functional.shapes(Tiny, CONFIG)) == expected


def test_a_bound_module_computes_with_the_given_parameters(params, x):
    np.testing.assert_allclose(apply(params, x), by_hand(params, np.asarray(x, np.float64)), atol=1e-5)


def test_binding_works_under_jit(params, x):
    np.testing.assert_allclose(jax.jit(apply)(params, x), apply(params, x), atol=1e-6)


def test_binding_works_under_vmap_over_parameters(params, x):
    stacked = jax.tree.map(lambda p: jnp.stack([p, -p]), params)
    both = jax.vmap(apply, in_axes=(0, None))(stacked, x)
    for one, sign in zip(both, (1, -1), strict=True):
        np.testing.assert_allclose(one, apply(jax.tree.map(lambda p, s=sign: s * p, params), x), atol=1e-6)


def test_the_gradient_has_the_tree_of_the_parameters(params, x):
    gradient = jax.grad(lambda p: jnp.sum(apply(p, x)))(params)
    assert jax.tree.structure(gradient) == jax.tree.structure(params)
    expected = np.asarray(x, np.float64)
    for k in range(CONFIG.depth):
        layer = params["layers"][k]
        expected = np.tanh(expected @ np.asarray(layer["kernel"]) + np.asarray(layer["bias"]))
    np.testing.assert_allclose(gradient["leave"]["kernel"], np.repeat(expected.sum(0)[:, None], 2, 1), rtol=1e-4)


def test_parameters_saved_and_loaded_give_the_same_output(params, x, tmp_path):
    weights.save_tree(tmp_path / "tiny.safetensors", params)
    loaded = weights.nest(weights.load_arrays(tmp_path / "tiny.safetensors")[0])
    assert jax.tree.structure(loaded) == jax.tree.structure(params)
    np.testing.assert_array_equal(apply(jax.tree.map(jnp.asarray, loaded), x), apply(params, x))
