"""How like a window of poses is to those that were learned from: a Gaussian kernel of windows.

    near_m(x) = exp(-|P (x - mean) - z_m|^2 / width)

with P the principal directions of the windows of training and z_m some of those windows. The drape is regressed on it,
and the largest of them says how far what a network learned of poses is to be trusted.
"""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.smad import driving

# Principal directions of windows that are told apart, and how far their sizes are levelled: 1 would make them equal.
DIRECTIONS, LEVELLED = 160, 0.3
# The kernel's width, in mean squared distances of two windows of training.
WIDTH = 0.8


@typing.no_type_check
@flax.struct.dataclass
class Kernel:
    """The mean window (i,), projection (i, q), centres (m, q) and width (); the i numbers of a window are those of its
    poses, newest first."""

    mean: Float[Array, "i"]
    projection: Float[Array, "i q"]
    centres: Float[Array, "m q"]
    width: Float[Array, ""]


def fit(
    features: Float[Array, "f p"],
    first: Int[Array, "f"],
    *,
    window: int = 8,
    stride: int = 2,
    centres: int = 1000,
    seed: int = 0,
) -> Kernel:
    """The kernel of f frames of takes one after the other: pose features, and the first frame of the take that a frame
    belongs to, before which the body is taken to have stood still. `centres`: at most as many as there are frames."""
    x = windows(features, first, window, stride)
    mean = x.mean(axis=0)
    sizes, directions = np.linalg.eigh((x - mean).T @ (x - mean) / len(x))
    kept = np.argsort(sizes)[::-1][:DIRECTIONS]
    # Directions in which nothing moved tell nothing apart.
    kept = kept[sizes[kept] > 1e-9 * sizes.max()]
    projection = directions[:, kept] * sizes[kept] ** (-LEVELLED / 2)
    points = (x - mean) @ projection
    parts = mean, projection, points[chosen(len(points), centres, seed)], reach(points)
    return Kernel(*(jnp.asarray(part, jnp.float32) for part in parts))


def chosen(frames: int, centres: int, seed: int) -> Int[np.ndarray, " m"]:
    """The frames whose windows are centres: so many, or all where there are fewer."""
    return np.sort(np.random.default_rng(seed).permutation(frames)[:centres])


def reach(points: Float[np.ndarray, "f q"]) -> np.ndarray:
    """The width of a kernel of such points: WIDTH times the mean squared distance of two of them."""
    return np.asarray(WIDTH * 2 * points.var(axis=0).sum())


def windows(
    features: Float[Array, "f p"], first: Int[Array, "f"], window: int, stride: int
) -> Float[np.ndarray, "f i"]:
    """The window that ends in each of the frames, as one row of numbers in double precision."""
    found = driving.windows(np.asarray(features, np.float64), np.asarray(first), window, stride)
    return found.reshape(len(found), -1)


def near(kernel: Kernel, window: Float[Array, "w p"]) -> Float[Array, "m"]:
    """How near a window is to each of the centres, newest pose first: from 0 to 1, which is where it is the same."""
    point = (window.reshape(-1) - kernel.mean) @ kernel.projection
    return jnp.exp(-jnp.sum((kernel.centres - point[None]) ** 2, axis=1) / kernel.width)
