"""How cloth lies under a window of poses, in closed form: the drape that the learned equilibrium departs from.

Kernel ridge regression of the offsets' principal components c from windows x of pose features,

    c(x) = sum_m w_m exp(-|P (x - mean) - z_m|^2 / width)

with P the principal directions of the windows of training and z_m some of those windows (Williams & Seeger 2001, "Using
the Nyström Method to Speed Up Kernel Machines"). It bends where linear regression cannot, and far from all that it was
learned from it falls back on the mean drape, where linear regression goes on.
"""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from avatarjax.smad import driving, linear

# Principal directions of windows that are told apart, and how far their sizes are levelled: 1 would make them equal.
DIRECTIONS, LEVELLED = 160, 0.3
# The kernel's width, in mean squared distances of two windows of training.
WIDTH = 0.8
# Of the kernel's own variance, 1: what keeps its factor real in double precision.
_JITTER = 1e-8


@typing.no_type_check
@flax.struct.dataclass
class Drape:
    """The mean offset (n, 3) and components (c, n, 3) of it; the mean window (i,), projection (i, q), centres (m, q),
    width () and weights (m, c) of the regression; i numbers of a window are those of its poses, newest first."""

    mean: Float[Array, "n 3"]
    basis: Float[Array, "c n 3"]
    window_mean: Float[Array, "i"]
    projection: Float[Array, "i q"]
    centres: Float[Array, "m q"]
    width: Float[Array, ""]
    weights: Float[Array, "m c"]


def fit(
    offsets: Float[Array, "f n 3"],
    features: Float[Array, "f p"],
    first: Int[Array, "f"],
    *,
    components: int = 48,
    window: int = 8,
    stride: int = 2,
    ridge: float = 0.1,
    centres: int = 1000,
    seed: int = 0,
) -> Drape:
    """The drape of f frames of takes one after the other: offsets, pose features, and the first frame of the take that
    a frame belongs to, before which the body is taken to have stood still.

    components, centres: at most as many as there are frames. ridge: the variance of what windows do not say, as a share
    of that of what they say. Raises ValueError for fewer frames than components.
    """
    mean, basis, wanted = linear.principal(offsets, components)
    x = driving.windows(np.asarray(features, np.float64), np.asarray(first), window, stride).reshape(len(wanted), -1)
    window_mean = x.mean(axis=0)
    sizes, directions = np.linalg.eigh((x - window_mean).T @ (x - window_mean) / len(x))
    kept = np.argsort(sizes)[::-1][:DIRECTIONS]
    # Directions in which nothing moved tell nothing apart.
    kept = kept[sizes[kept] > 1e-9 * sizes.max()]
    projection = directions[:, kept] * sizes[kept] ** (-LEVELLED / 2)
    points = (x - window_mean) @ projection
    width = WIDTH * 2 * points.var(axis=0).sum()
    some = np.sort(np.random.default_rng(seed).permutation(len(points))[:centres])
    middle = points[some]

    def kernel(a, b):
        apart = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2 * a @ b.T
        return np.exp(-np.maximum(apart, 0) / width)

    factor = np.linalg.cholesky(kernel(middle, middle) + _JITTER * np.eye(len(middle)))
    design = scipy.linalg.solve_triangular(factor, kernel(middle, points), lower=True).T
    found = np.linalg.solve(design.T @ design + ridge * np.eye(len(middle)), design.T @ wanted)
    weights = scipy.linalg.solve_triangular(factor.T, found)
    parts = (mean, basis, window_mean, projection, middle, np.asarray(width), weights)
    return Drape(*(jnp.asarray(part, jnp.float32) for part in parts))


def offsets(drape: Drape, window: Float[Array, "w p"]) -> Float[Array, "n 3"]:
    """The offsets under one window of poses, newest first, metres."""
    point = (window.reshape(-1) - drape.window_mean) @ drape.projection
    near = jnp.exp(-jnp.sum((drape.centres - point[None]) ** 2, axis=1) / drape.width)
    return drape.mean + jnp.tensordot(near @ drape.weights, drape.basis, 1)
