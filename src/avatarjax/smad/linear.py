"""Linear models of how nodes lie: yardsticks.

A learned deformer that does not beat them has not worked yet. With c the principal components of the nodes' offsets
from the driven surface in training, x_t a window of pose features and W from ridge regression:

    mean drape          o_t = mean                     (no components)
    ridge regression    c_t = W x_t                    (lags 0)
    linear state space  c_t = W (x_t, c_{t-1}, ...)    (lags 1 and more; autoregressive)
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.smad import driving

# How much further than in training a component may go.
REACH = 1.5


@typing.no_type_check
@flax.struct.dataclass
class Linear:
    """The mean offset (n, 3), components (c, n, 3) with the furthest (c,) each went in training, one over the
    components' typical size () and weights (i, c) of a window of `window` poses, `stride` frames apart, of the newest
    `lags` components and of a constant 1."""

    mean: Float[Array, "n 3"]
    basis: Float[Array, "c n 3"]
    reach: Float[Array, "c"]
    unit: Float[Array, ""]
    weights: Float[Array, "i c"]
    window: int = flax.struct.field(pytree_node=False)
    stride: int = flax.struct.field(pytree_node=False)
    lags: int = flax.struct.field(pytree_node=False)


def fit(
    offsets: Float[Array, "f n 3"],
    features: Float[Array, "f p"],
    first: Int[Array, "f"],
    *,
    components: int = 48,
    window: int = 8,
    stride: int = 2,
    lags: int = 0,
    ridge: float = 0.02,
) -> Linear:
    """The model of f frames of takes one after the other, in closed form: offsets, pose features, and the first frame
    of the take that a frame belongs to, before which the body is taken to have stood still.

    components: no more than there are coordinates. ridge: of the squared weights against a frame's squared error, pose
    features and components being of unit size. Raises ValueError for fewer frames than components.
    """
    mean, basis, wanted = principal(offsets, components)
    count = len(wanted)
    unit = 1 / max(float(np.sqrt(np.mean(wanted**2))), 1e-9) if len(basis) else 1.0
    starts = np.asarray(first)
    poses = driving.windows(np.asarray(features, np.float64), starts, window, stride)

    def earlier(frames: int) -> np.ndarray:
        return np.maximum(np.arange(count) - frames, starts)

    inputs = [poses.reshape(count, -1)]
    inputs += [unit * wanted[earlier(k)] for k in range(1, lags + 1)]
    x = np.concatenate([*inputs, np.ones((count, 1))], axis=1)
    weights = np.linalg.solve(x.T @ x + ridge * count * np.eye(x.shape[1]), x.T @ wanted)
    return Linear(
        jnp.asarray(mean, jnp.float32),
        jnp.asarray(basis, jnp.float32),
        jnp.asarray(np.abs(wanted).max(axis=0), jnp.float32),
        jnp.asarray(unit, jnp.float32),
        jnp.asarray(weights, jnp.float32),
        window,
        stride,
        lags,
    )


def principal(
    offsets: Float[Array | np.ndarray, "f n 3"], components: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "c n 3"], Float[np.ndarray, "f c"]]:
    """The mean of offsets, their first principal components, and every frame in these. Raises ValueError for fewer
    frames than components."""
    if len(offsets) < components:
        raise ValueError(f"{components} components need as many frames, there are {len(offsets)}")
    places = np.asarray(offsets, np.float64)
    mean = places.mean(axis=0)
    flat = (places - mean).reshape(len(places), -1)
    basis = np.linalg.svd(flat, full_matrices=False)[2][:components]
    return mean, basis.reshape(-1, *mean.shape), flat @ basis.T


def rollout(linear: Linear, features: Float[Array, "t p"]) -> Float[Array, "t n 3"]:
    """The offsets under every one of t poses, metres; before the first the body stood still, and with `lags` the cloth
    hung at the mean."""
    back = jnp.arange(len(features))[:, None] - linear.stride * jnp.arange(linear.window)[None]
    windows = features[jnp.maximum(back, 0)]

    def advance(before, window):
        now = predict(linear, window, before)
        return jnp.concatenate([now[None], before])[: linear.lags], now

    found = jax.lax.scan(advance, jnp.zeros((linear.lags, len(linear.basis))), windows)[1]
    return linear.mean[None] + jnp.tensordot(found, linear.basis, 1)


def predict(linear: Linear, window: Float[Array, "w p"], before: Float[Array, "l c"]) -> Float[Array, "c"]:
    """The components under a window of poses and after so many components, both newest first. Under poses that are
    like none of training each goes little further than it went there."""
    x = jnp.concatenate([window.reshape(-1), linear.unit * before.reshape(-1), jnp.ones(1)])
    return jnp.clip(x @ linear.weights, -REACH * linear.reach, REACH * linear.reach)
