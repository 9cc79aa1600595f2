"""Cloth against solid surfaces and against itself, as planes and spheres found again every few steps.

A solid is known by points with normals on its skin, in a few groups of limbs. The nearest point of each group gives a
vertex a plane that moves with the skin: any shape that is skinned can be collided with, and a leg that swings past
another is seen coming. Where the surface is convex the plane lies outside it, which errs on the safe side.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# How many points are compared with all vertices at a time: their distances stay in the cache.
_BLOCK = 16
# Metres: a plane holds only so far around its point, and a vertex deeper than this is on the other side of a limb.
_PLANE_RADIUS, _DEEPEST = 0.05, 0.10
# The same for a sheet under a sheet, which is thin: deeper, a vertex is on its other side, and aside, beyond its edge.
_LAYER_RADIUS = 0.03


@typing.no_type_check
@flax.struct.dataclass
class Surface:
    """Points (g, m, 3) on solid surfaces in g groups and their unit normals (g, m, 3), pointing out; metres."""

    points: Float[Array, "g m 3"]
    normals: Float[Array, "g m 3"]


@typing.no_type_check
@flax.struct.dataclass
class Capsules:
    """Segments from and to (k, 3) with radii (k,), metres: frictionless solids that bridge gaps in a surface."""

    begin: Float[Array, "k 3"]
    end: Float[Array, "k 3"]
    radii: Float[Array, " k"]


def nearest(
    queries: Float[Array, "n 3"],
    points: Float[Array, "m 3"],
    rest_queries: Float[Array, "n 3"] | None = None,
    rest_points: Float[Array, "m 3"] | None = None,
    apart: float = 0.0,
) -> Int[Array, " n"]:
    """The index (n,) of the nearest of points (m, 3) for each query (n, 3).

    With `rest_queries` and `rest_points`, only points that are more than `apart` metres away in that other pose count
    (0 where there are none). All pairs are compared: distances carry the index in their lowest bits, so that the
    minimum of integers finds both; squared distances are right to one part in 2^(23 - log2 m).
    """
    count = points.shape[0]
    blocks = -(-count // _BLOCK)
    bits = max(1, (blocks * _BLOCK - 1).bit_length())
    mask = (1 << bits) - 1
    far = jnp.pad(points, ((0, blocks * _BLOCK - count), (0, 0)), constant_values=1e6).reshape(blocks, _BLOCK, 3)
    known = rest_queries is not None and rest_points is not None
    other = jnp.pad(rest_points, ((0, blocks * _BLOCK - count), (0, 0))).reshape(blocks, _BLOCK, 3) if known else far

    def squares(a: Array, b: Array) -> Array:
        return sum((a[None, :, k] - b[:, None, k]) ** 2 for k in range(3))

    def block(best: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, None]:
        own, rest, start = inputs
        distance = jax.lax.bitcast_convert_type(squares(queries, own), jnp.int32)
        packed = (distance & ~mask) | (start + jnp.arange(_BLOCK, dtype=jnp.int32))[:, None]
        if known:
            packed = jnp.where(squares(rest_queries, rest) > apart**2, packed, jnp.iinfo(jnp.int32).max & ~mask)
        return jnp.minimum(best, packed.min(axis=0)), None

    start = jnp.arange(blocks, dtype=jnp.int32) * _BLOCK
    best, _ = jax.lax.scan(
        block, jnp.full(queries.shape[0], jnp.iinfo(jnp.int32).max & ~mask, jnp.int32), (far, other, start)
    )
    return jnp.minimum(best & mask, count - 1)


def find_planes(positions: Float[Array, "n 3"], surface: Surface) -> Int[Array, "g n"]:
    """The nearest point (g, n) of each group of a surface for each vertex (n, 3)."""
    return jnp.stack([nearest(positions, points) for points in surface.points])


def take_planes(surface: Surface, planes: Int[Array, "g n"]) -> Surface:
    """The points and normals that `find_planes` found, as columns (g, 3, n)."""
    group = jnp.arange(planes.shape[0])[:, None]
    return jax.tree.map(lambda x: jnp.moveaxis(x[group, planes], 2, 1), surface)


def push_out(
    positions: Float[Array, "3 n"],
    previous: Float[Array, "3 n"],
    planes: Surface,
    moved: Float[Array, "g 3 n"],
    clearance: Float[Array, " n"],
    friction: Float[Array, " n"],
) -> Float[Array, "3 n"]:
    """Positions (3, n) moved out of the half-spaces behind planes (g, 3, n) with unit normals, one group after the
    other.

    `previous` (3, n) are the positions before the step and `moved` (g, 3, n) how far the surface went in it: friction
    takes away up to the vertex's share of the slip between them (Coulomb, at the level of positions). Coordinates are
    columns, because XLA's CPU backend does not vectorise over a last axis of three.
    """

    def group(x: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, None]:
        point, normal, carried = inputs
        offset = x - point
        height = _dot(offset, normal)
        aside = _dot(offset, offset) - height * height
        held = (aside < _PLANE_RADIUS**2) & (height > -_DEEPEST)
        depth = jnp.where(held, jnp.maximum(clearance - height, 0), 0.0)
        slip = x - previous - carried
        slip = slip - _dot(slip, normal)[None] * normal
        kept = jnp.minimum(friction * depth * jax.lax.rsqrt(_dot(slip, slip) + 1e-18), 1.0)
        return x + depth[None] * normal - kept[None] * slip, None

    return jax.lax.scan(group, positions, (planes.points, planes.normals, moved))[0]


def push_out_of_capsules(positions: Float[Array, "3 n"], capsules: Capsules) -> Float[Array, "3 n"]:
    """Positions (3, n) moved out of capsules, one after the other."""

    def capsule(x: Array, inputs: Capsules) -> tuple[Array, None]:
        axis = (inputs.end - inputs.begin)[:, None]
        offset = x - inputs.begin[:, None]
        share = jnp.clip(_dot(offset, axis) / (_dot(axis, axis) + 1e-12), 0, 1)
        away = offset - share[None] * axis
        inverse = jax.lax.rsqrt(_dot(away, away) + 1e-18)
        return x + jnp.maximum(inputs.radii * inverse - 1, 0)[None] * away, None

    return jax.lax.scan(capsule, positions, capsules)[0]


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def find_inner(positions: Float[Array, "n 3"], pieces: tuple[int, ...]) -> Int[Array, " n"]:
    """For each vertex (n, 3) the nearest one of the pieces before its own, which it is worn over; itself where there
    is none. `pieces` says how many vertices each has, in the order in which they are worn."""
    found, start = [], 0
    for count in pieces:
        own = slice(start, start + count)
        found.append(nearest(positions[own], positions[:start]) if start else jnp.arange(count, dtype=jnp.int32))
        start += count
    return jnp.concatenate(found)


def keep_outside(
    positions: Float[Array, "n 3"],
    inner: Int[Array, " n"],
    normals: Float[Array, "n 3"],
    over: Float[Array, " n"],
    gap: float,
) -> Float[Array, "n 3"]:
    """Positions (n, 3) moved to `gap` metres outside the planes of the vertices `inner` (n,) that they are worn over,
    whose unit normals are rows of `normals`; `over` (n,) is 0 where that does not hold."""
    point, normal = positions[inner].T, normals[inner].T
    offset = positions.T - point
    height = _dot(offset, normal)
    aside = _dot(offset, offset) - height * height
    held = (aside < _LAYER_RADIUS**2) & (height > -_LAYER_RADIUS)
    depth = jnp.where(held, jnp.maximum(gap - height, 0), 0.0) * over
    return positions + (depth[None] * normal).T


def find_neighbours(
    positions: Float[Array, "n 3"], rest: Float[Array, "n 3"], pieces: tuple[int, ...], apart: float
) -> Int[Array, " n"]:
    """For each vertex the nearest of its own piece that was more than `apart` metres away in the pattern."""
    found, start = [], 0
    for count in pieces:
        own = slice(start, start + count)
        found.append(start + nearest(positions[own], positions[own], rest[own], rest[own], apart))
        start += count
    return jnp.concatenate(found)


def separate(
    positions: Float[Array, "n 3"],
    neighbours: Int[Array, " n"],
    rest: Float[Array, "n 3"],
    free: Float[Array, " n"],
    distance: float,
) -> Float[Array, "n 3"]:
    """Positions (n, 3) moved away from `neighbours` (n,) that are nearer than `distance` metres, but not in the
    pattern.

    Each of the two goes half the way (each computes its own half), all of it where the other is sewn on (`free` 0).
    """
    offset = positions - positions[neighbours]
    length = jnp.sqrt(jnp.sum(offset * offset, axis=1) + 1e-18)
    between = jnp.sum((rest - rest[neighbours]) ** 2, axis=1)
    lacking = jnp.where(between > distance**2, jnp.maximum(distance - length, 0), 0.0)
    share = lacking * free / jnp.maximum(free + free[neighbours], 1e-9)
    return positions + (share / length)[:, None] * offset
