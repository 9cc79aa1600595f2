"""How the surface stands at each texel: local frames from neighbouring texels, and how far they have turned."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax import rotations
from avatarjax.posmap.atlas import Atlas
from avatarjax.posmap.neighbours import SELF, STEPS, around, neighbours

# Neighbours further apart on the A-pose than this, in distances of texels, are on different parts of the body.
_APART = 3.0
_TINY = 1e-12
_ABOVE, _LEFT, _RIGHT, _BELOW = (STEPS.index(s) for s in ((-1, 0), (0, -1), (0, 1), (1, 0)))


@typing.no_type_check
@flax.struct.dataclass
class Tangents:
    """The differences that give the two tangents of the surface at each texel.

    neighbours (t, 9) as `posmap.neighbours`; across, down (t, 9) their weights, zero where the surface has no
    neighbour along the row or the column.
    """

    neighbours: Int[Array, "t 9"]
    across: Float[Array, "t 9"]
    down: Float[Array, "t 9"]


def tangents(atlas: Atlas) -> Tangents:
    """Central differences where both neighbours are of the same surface, one-sided ones where one of them is."""
    beside = neighbours(atlas)
    reference = np.append(np.asarray(atlas.reference, np.float64), np.full((1, 3), np.inf), axis=0)
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(reference[beside] - reference[:-1, None], axis=-1)
    linked = distance < _APART * np.median(distance[np.isfinite(distance) & (distance > 0)])

    def weights(before: int, after: int) -> Array:
        both = linked[:, before] & linked[:, after]
        found = np.zeros(beside.shape)
        found[:, before], found[:, after] = -1.0 * linked[:, before], 1.0 * linked[:, after]
        found[:, SELF] = 1.0 * linked[:, before] - 1.0 * linked[:, after]
        return jnp.asarray(found / np.where(both, 2, 1)[:, None], jnp.float32)

    return Tangents(jnp.asarray(beside), weights(_LEFT, _RIGHT), weights(_ABOVE, _BELOW))


class Frames(typing.NamedTuple):
    """At each texel: an orthonormal frame (t, 3, 3), columns along the row, up the column and outwards; the
    lengths (t, 2) of the tangents; and where it is `known` (t,): the surface has a neighbour in both directions."""

    axes: Float[Array, "t 3 3"]
    lengths: Float[Array, "t 2"]
    known: Float[Array, "t"]


def frames(tangents: Tangents, texels: Float[Array, "t 3"]) -> Frames:
    """Frames of a posed surface from its texels (t, 3), in their unit; any orthonormal ones where not known."""
    beside = around(tangents.neighbours, texels)
    across, down = (jnp.einsum("tk,tkc->tc", w, beside) for w in (tangents.across, tangents.down))
    # Every view sees the surface from outside, its columns to the right and its rows down.
    normal = jnp.cross(down, across)
    # Neither without a neighbour in each direction nor where the two tangents are parallel is there a frame.
    area = _squared(across) * _squared(down)
    known = _squared(normal) > 1e-6 * area
    lengths = jnp.sqrt(jnp.maximum(jnp.stack([_squared(across), _squared(down)], axis=-1), _TINY))
    x = jnp.where(known[:, None], across, jnp.asarray([[1.0, 0.0, 0.0]]))
    z = jnp.where(known[:, None], normal, jnp.asarray([[0.0, 0.0, 1.0]]))
    x, z = (v * jax.lax.rsqrt(_squared(v))[:, None] for v in (x, z))
    return Frames(jnp.stack([x, jnp.cross(z, x), z], axis=-1), lengths, known.astype(texels.dtype))


def turns(before: Frames, after: Frames, otherwise: Float[Array, "4"]) -> Float[Array, "t 4"]:
    """Quaternions that turn the surface from one pose to another; `otherwise` where either frame is not known."""
    turned = rotations.from_matrix(jnp.einsum("tij,tkj->tik", after.axes, before.axes))
    known = (before.known * after.known)[:, None] > 0
    return jnp.where(known, turned, otherwise[None])


def _squared(x: Float[Array, "t 3"]) -> Float[Array, "t"]:
    return jnp.sum(x * x, axis=-1)
