"""Network parameters for tests, without compiling an initialiser."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from avatarjax.nets import functional


def random_like(shapes, seed=0, scale=0.3):
    """A tree of the shapes with normal entries: biases and zero-initialised heads too do something then."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda s: jnp.asarray(scale * rng.normal(size=s.shape), jnp.float32), shapes)


def random_params(cls, config, seed=0, scale=0.3):
    """Parameters of the network `cls(config)`."""
    return random_like(functional.shapes(cls, config), seed, scale)


def random_module(make, seed=0, scale=0.3):
    """The module that `make()` builds, with random parameters."""
    graph, state = nnx.split(nnx.eval_shape(make))
    return nnx.merge(graph, random_like(state, seed, scale))
