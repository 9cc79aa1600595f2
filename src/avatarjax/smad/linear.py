"""Linear models of how nodes lie, as yardsticks: a learned deformer that does not beat them has not worked yet.

With c the principal components of the nodes' offsets from the driven surface in training, x_t a window of pose features
and W from ridge regression:

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
from jaxtyping import Array, Float

from avatarjax.smad import driving, dynamics
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.driving import Pose
from avatarjax.smad.dynamics import System
from avatarjax.smad.train_dynamics import Recorded


@typing.no_type_check
@flax.struct.dataclass
class Linear:
    """The mean offset (n, 3), components (c, n, 3), one over the components' typical size () and weights (i, c) of a
    window of `window` poses, `stride` frames apart, of the newest `lags` components and of a constant 1."""

    mean: Float[Array, "n 3"]
    basis: Float[Array, "c n 3"]
    unit: Float[Array, ""]
    weights: Float[Array, "i c"]
    window: int = flax.struct.field(pytree_node=False)
    stride: int = flax.struct.field(pytree_node=False)
    lags: int = flax.struct.field(pytree_node=False)


def fit(
    recorded: Recorded, *, components: int = 48, window: int = 6, stride: int = 2, lags: int = 0, ridge: float = 0.03
) -> Linear:
    """The model of recorded takes, in closed form.

    ridge: of the squared weights against a frame's squared error, pose features and components being of unit size.
    Raises ValueError for fewer frames than components.
    """
    offsets = np.asarray(recorded.offsets, np.float64)
    count, nodes = offsets.shape[:2]
    if count < components:
        raise ValueError(f"{components} components need as many frames, there are {count}")
    mean = offsets.mean(axis=0)
    flat = (offsets - mean).reshape(count, -1)
    basis = np.linalg.svd(flat, full_matrices=False)[2][:components]
    wanted = flat @ basis.T
    unit = 1 / max(float(np.sqrt(np.mean(wanted**2))), 1e-9) if components else 1.0
    first = np.asarray(recorded.first)

    def earlier(frames: int) -> np.ndarray:
        return np.maximum(np.arange(count) - frames, first)

    features = np.asarray(recorded.features, np.float64)
    inputs = [features[earlier(stride * k)] for k in range(window)]
    inputs += [unit * wanted[earlier(k)] for k in range(1, lags + 1)]
    x = np.concatenate([*inputs, np.ones((count, 1))], axis=1)
    weights = np.linalg.solve(x.T @ x + ridge * count * np.eye(x.shape[1]), x.T @ wanted)
    return Linear(
        jnp.asarray(mean, jnp.float32),
        jnp.asarray(basis.reshape(components, nodes, 3), jnp.float32),
        jnp.asarray(unit, jnp.float32),
        jnp.asarray(weights, jnp.float32),
        window,
        stride,
        lags,
    )


def rollout(config: SmadConfig, linear: Linear, system: System, poses: Pose) -> Float[Array, "t n 3"]:
    """The nodes in the body frame of every one of t poses, metres; before the first the body stood still, and with
    `lags` the cloth hung at the mean."""
    scaling = system.scaling
    features = (driving.track(poses, config.dt) - scaling.pose_mean[None]) / scaling.pose_scale[None]
    back = jnp.arange(len(features))[:, None] - linear.stride * jnp.arange(linear.window)[None]
    windows = features[jnp.maximum(back, 0)].reshape(len(features), -1)
    count = len(linear.basis)

    def advance(before, window):
        x = jnp.concatenate([window, linear.unit * before.reshape(-1), jnp.ones(1)])
        now = x @ linear.weights
        return jnp.concatenate([now[None], before])[: linear.lags], now

    found = jax.lax.scan(advance, jnp.zeros((linear.lags, count)), windows)[1]
    surface = jax.lax.map(lambda pose: dynamics.driven(system, pose), poses)
    return surface + linear.mean[None] + jnp.tensordot(found, linear.basis, 1)
