"""How cloth lies under a window of poses, in closed form: the drape that the learned equilibrium departs from.

Kernel ridge regression of the offsets' principal components c from windows x of poses (`kernel`) and, with a memory,
from how the cloth lay l frames before,

    c_t = sum_m w_m near_m(x_t) (a + (1 - a) exp(-|c_{t-l} - p_m|^2 / reach))

where p_m is how it lay l frames before centre m: a dynamical system that is learned without a gradient. It answers to
itself only every l frames, so that its errors are not carried on thirty times a second (docs/smad.md). Solved with the
Nyström method (Williams & Seeger 2001, "Using the Nyström Method to Speed Up Kernel Machines"). It bends where linear
regression cannot, and far from all that it was learned from it falls back on the mean drape, where linear regression
goes on.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from avatarjax.smad import kernel, linear
from avatarjax.smad.kernel import Kernel

# Of the kernel's own variance, 1: what keeps its factor real in double precision.
_JITTER = 1e-8
# The share of a centre that counts whatever was before: what is left of it where the past is unlike any.
ANYHOW = 0.3
# How often a drape is asked what follows itself until it is taken to be at rest.
_RESTING = 50


@typing.no_type_check
@flax.struct.dataclass
class Drape:
    """The mean offset (n, 3), components (c, n, 3) of it, and the kernel whose m values have weights (m, c); with a
    memory also how cloth lay before each centre, past (m, c), and the width () of the kernel of that."""

    mean: Float[Array, "n 3"]
    basis: Float[Array, "c n 3"]
    kernel: Kernel
    weights: Float[Array, "m c"]
    past: Float[Array, "m c"] | None = None
    reach: Float[Array, ""] | None = None


def fit(
    offsets: Float[Array, "f n 3"],
    features: Float[Array, "f p"],
    first: Int[Array, "f"],
    *,
    components: int = 48,
    window: int = 8,
    stride: int = 2,
    memory: int = 0,
    ridge: float = 0.1,
    centres: int = 1000,
    seed: int = 0,
) -> Drape:
    """The drape of f frames of takes one after the other: offsets, and what `kernel.fit` takes.

    components: at most as many as there are frames. memory: how many frames before the cloth's own place counts too;
    0: not at all. ridge: the variance of what windows do not say, as a share of that of what they say. Raises
    ValueError for fewer frames than components.
    """
    mean, basis, wanted = linear.principal(offsets, components)
    fitted = kernel.fit(features, first, window=window, stride=stride, centres=centres, seed=seed)
    x, projection = (np.asarray(each, np.float64) for each in (fitted.mean, fitted.projection))
    points = [(kernel.windows(features, first, window, stride) - x) @ projection]
    widths, past, reach = [float(fitted.width)], None, None
    some = kernel.chosen(len(wanted), centres, seed)
    if memory:
        before = wanted[np.maximum(np.arange(len(wanted)) - memory, first)]
        past, reach = before[some], kernel.reach(before)
        points, widths = [*points, before], [*widths, float(reach)]
    middle = [part[some] for part in points]

    def near(a, b):
        found = [_gaussian(*each) for each in zip(a, b, widths, strict=True)]
        return found[0] * (ANYHOW + (1 - ANYHOW) * found[1]) if memory else found[0]

    factor = np.linalg.cholesky(near(middle, middle) + _JITTER * np.eye(len(some)))
    design = scipy.linalg.solve_triangular(factor, near(middle, points), lower=True).T
    found = np.linalg.solve(design.T @ design + ridge * np.eye(len(some)), design.T @ wanted)
    weights = scipy.linalg.solve_triangular(factor.T, found)
    arrays = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), (mean, basis, weights, past, reach))
    return Drape(*arrays[:2], fitted, *arrays[2:])


def _gaussian(a: Float[np.ndarray, "f q"], b: Float[np.ndarray, "g q"], width: float) -> Float[np.ndarray, "f g"]:
    apart = np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2 * a @ b.T
    return np.exp(-np.maximum(apart, 0) / width)


def components(drape: Drape, window: Float[Array, "w p"], before: Float[Array, "c"]) -> Float[Array, "c"]:
    """How cloth lies under one window of poses, newest first, as components of the drape; `before` is how it lay as
    many frames before as the drape remembers, and nothing to one without a memory."""
    near = kernel.near(drape.kernel, window)
    if drape.past is not None and drape.reach is not None:
        like = jnp.exp(-jnp.sum((drape.past - before[None]) ** 2, axis=1) / drape.reach)
        near = near * (ANYHOW + (1 - ANYHOW) * like)
    return near @ drape.weights


def at_rest(drape: Drape, window: Float[Array, "w p"]) -> Float[Array, "c"]:
    """How cloth lies, as components, where the window has been the same for long."""
    begin = jnp.zeros(len(drape.basis))
    return jax.lax.fori_loop(0, _RESTING, lambda _, before: components(drape, window, before), begin)


def offsets(drape: Drape, found: Float[Array, "c"]) -> Float[Array, "n 3"]:
    """The offsets of such components, metres."""
    return drape.mean + jnp.tensordot(found, drape.basis, 1)
