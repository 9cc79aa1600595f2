"""The cube about a figure's points in which its appearance is learned (UNICA B.1)."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Float


@typing.no_type_check
@flax.struct.dataclass
class Box:
    """The cube about a point cloud that becomes [-0.5, 0.5]^3: its centre (3,) and side (), in the cloud's unit."""

    centre: Float[Array, "3"]
    side: Float[Array, ""]


def bounding_box(points: Float[Array, "n 3"]) -> Box:
    """The smallest cube about the points that shares their bounding box's centre."""
    low, high = points.min(0), points.max(0)
    return Box((low + high) / 2, jnp.max(high - low))


def into_box(box: Box, points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Points in [-0.5, 0.5]^3 (UNICA B.1)."""
    return (points - box.centre[None]) / box.side
