"""How cloth lies under a window of poses, in closed form: the drape that the learned equilibrium departs from.

Kernel ridge regression of the offsets' principal components c from windows x of poses (`kernel`),

    c(x) = sum_m w_m near_m(x)

with the Nyström method (Williams & Seeger 2001, "Using the Nyström Method to Speed Up Kernel Machines"). It bends where
linear regression cannot, and far from all that it was learned from it falls back on the mean drape, where linear
regression goes on.
"""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from avatarjax.smad import kernel, linear
from avatarjax.smad.kernel import Kernel

# Of the kernel's own variance, 1: what keeps its factor real in double precision.
_JITTER = 1e-8


@typing.no_type_check
@flax.struct.dataclass
class Drape:
    """The mean offset (n, 3), components (c, n, 3) of it, and the kernel whose m values have weights (m, c)."""

    mean: Float[Array, "n 3"]
    basis: Float[Array, "c n 3"]
    kernel: Kernel
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
    """The drape of f frames of takes one after the other: offsets, and what `kernel.fit` takes.

    components: at most as many as there are frames. ridge: the variance of what windows do not say, as a share of that
    of what they say. Raises ValueError for fewer frames than components.
    """
    mean, basis, wanted = linear.principal(offsets, components)
    fitted = kernel.fit(features, first, window=window, stride=stride, centres=centres, seed=seed)
    x, projection, middle = (np.asarray(each, np.float64) for each in (fitted.mean, fitted.projection, fitted.centres))
    points = (kernel.windows(features, first, window, stride) - x) @ projection

    def near(a, b):
        apart = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2 * a @ b.T
        return np.exp(-np.maximum(apart, 0) / float(fitted.width))

    factor = np.linalg.cholesky(near(middle, middle) + _JITTER * np.eye(len(middle)))
    design = scipy.linalg.solve_triangular(factor, near(middle, points), lower=True).T
    found = np.linalg.solve(design.T @ design + ridge * np.eye(len(middle)), design.T @ wanted)
    weights = scipy.linalg.solve_triangular(factor.T, found)
    mean, basis, weights = (jnp.asarray(part, jnp.float32) for part in (mean, basis, weights))
    return Drape(mean, basis, fitted, weights)


def offsets(drape: Drape, window: Float[Array, "w p"]) -> Float[Array, "n 3"]:
    """The offsets under one window of poses, newest first, metres."""
    return drape.mean + jnp.tensordot(kernel.near(drape.kernel, window) @ drape.weights, drape.basis, 1)
