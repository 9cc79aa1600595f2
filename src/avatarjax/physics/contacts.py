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

# Three arrays of coordinates: XLA's CPU backend is several times slower over a last axis of three.
Columns = tuple[Array, Array, Array]

# So many queries are compared with so many points at a time.
_QUERIES, _POINTS = 128, 32
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
    (0 where there are none). Each block of queries looks at blocks of points in the order of the gaps between their
    bounding boxes, until none can hold a nearer point: quick where queries that follow each other are near each other,
    as in a mesh, and points too. Distances carry the index in their lowest bits, so that the minimum of integers finds
    both; squared distances are right to one part in 2^(23 - log2 m).
    """
    count = points.shape[0]
    mask = (1 << max(1, (count - 1).bit_length())) - 1
    none = jnp.int32(jnp.iinfo(jnp.int32).max & ~mask)
    # With a rest pose vectors have six coordinates: in the pose, and in the other one.
    known = rest_queries is not None and rest_points is not None
    asked = _blocks(columns(queries) + (columns(rest_queries) if known else ()), _QUERIES)
    held = _blocks(columns(points) + (columns(rest_points) if known else ()), _POINTS)
    low, high = (tuple(f(c, axis=1) for c in held[:3]) for f in (jnp.min, jnp.max))

    def packed(squares: Array) -> Array:
        return jax.lax.bitcast_convert_type(squares, jnp.int32) & ~mask

    def search(own: tuple[Array, ...]) -> Array:
        sides = zip(low, high, own[:3], strict=True)
        gaps = tuple(jnp.maximum(jnp.maximum(a - c.max(), c.min() - b), 0) for a, b, c in sides)

        def promising(carry: tuple[Array, Array]) -> Array:
            left, best = carry
            return left.min() <= best.max()

        def look(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            left, best = carry
            k = jnp.argmin(left)
            offset = tuple(q[None] - p[k][:, None] for q, p in zip(own, held, strict=True))
            index = jnp.minimum(k * _POINTS + jnp.arange(_POINTS, dtype=jnp.int32), count - 1)
            found = packed(dot(offset[:3], offset[:3])) | index[:, None]
            if known:
                found = jnp.where(dot(offset[3:], offset[3:]) > apart**2, found, none)
            return left.at[k].set(jnp.iinfo(jnp.int32).max), jnp.minimum(best, found.min(axis=0))

        return jax.lax.while_loop(promising, look, (packed(dot(gaps, gaps)), jnp.full(_QUERIES, none)))[1]

    # One block after the other: none waits for what another still looks at. An accelerator would be idle meanwhile.
    best = jax.lax.platform_dependent(asked, cpu=lambda x: jax.lax.map(search, x), default=jax.vmap(search))
    return best.reshape(-1)[: queries.shape[0]] & mask


def _blocks(vectors: tuple[Array, ...], size: int) -> tuple[Array, ...]:
    """Coordinates (n,) in blocks (b, size), as constants; the last vector fills the last block up."""
    count = -(-vectors[0].shape[0] // size)
    padding = 0, count * size - vectors[0].shape[0]
    return tuple(jax.lax.stop_gradient(jnp.pad(c, padding, mode="edge").reshape(count, size)) for c in vectors)


def find_planes(positions: Float[Array, "n 3"], surface: Surface) -> Int[Array, "g n"]:
    """The nearest point (g, n) of each group of a surface for each vertex (n, 3)."""
    return jax.lax.map(lambda points: nearest(positions, points), surface.points)


def take_planes(surface: Surface, planes: Int[Array, "g n"]) -> tuple[Columns, Columns]:
    """The points and normals that `find_planes` found, each as columns of shape (g, n)."""
    group = jnp.arange(planes.shape[0])[:, None]
    return columns(surface.points[group, planes]), columns(surface.normals[group, planes])


def push_out(
    x: Columns,
    previous: Columns,
    points: Columns,
    normals: Columns,
    moved: Columns,
    clearance: Float[Array, " n"],
    friction: Float[Array, " n"],
) -> Columns:
    """Positions moved out of the half-spaces behind planes with unit normals, one group of planes after the other.

    `previous` are the positions before the step; points, normals and `moved`, how far the surface went in the step,
    have columns (g, n). Friction takes away up to the vertex's share of the slip between vertex and surface (Coulomb,
    at the level of positions).
    """

    def group(x: Columns, inputs: tuple[Columns, Columns, Columns]) -> tuple[Columns, None]:
        point, normal, carried = inputs
        offset = minus(x, point)
        height = dot(offset, normal)
        aside = dot(offset, offset) - height * height
        held = (aside < _PLANE_RADIUS**2) & (height > -_DEEPEST)
        depth = jnp.where(held, jnp.maximum(clearance - height, 0), 0.0)
        slip = minus(minus(x, previous), carried)
        slip = along(slip, -dot(slip, normal), normal)
        kept = jnp.minimum(friction * depth * jax.lax.rsqrt(dot(slip, slip) + 1e-18), 1.0)
        return along(along(x, depth, normal), -kept, slip), None

    return jax.lax.scan(group, x, (points, normals, moved))[0]


def push_out_of_capsules(x: Columns, capsules: Capsules) -> Columns:
    """Positions moved out of capsules, one after the other."""

    def capsule(x: Columns, inputs: Capsules) -> tuple[Columns, None]:
        begin, axis = columns(inputs.begin), columns(inputs.end - inputs.begin)
        offset = minus(x, begin)
        share = jnp.clip(dot(offset, axis) / (dot(axis, axis) + 1e-12), 0, 1)
        away = along(offset, -share, axis)
        lacking = jnp.maximum(inputs.radii * jax.lax.rsqrt(dot(away, away) + 1e-18) - 1, 0)
        return along(x, lacking, away), None

    return jax.lax.scan(capsule, x, capsules)[0]


def find_inner(
    positions: Float[Array, "n 3"], pieces: tuple[int, ...], covering: tuple[Int[Array, " _c"], ...]
) -> Int[Array, " n"]:
    """For the vertices `covering` of each piece the nearest one of the pieces before it, which they are worn over;
    for the others (n,) themselves. `pieces` says how many vertices each has, in the order in which they are worn."""
    inner = jnp.arange(positions.shape[0], dtype=jnp.int32)
    start = 0
    for count, own in zip(pieces, covering, strict=True):
        if own.shape[0]:
            inner = inner.at[own].set(nearest(positions[own], positions[:start]))
        start += count
    return inner


def keep_outside(x: Columns, inner: Int[Array, " n"], normals: Columns, gap: float) -> Columns:
    """Positions moved to `gap` metres outside the planes of the vertices `inner` (n,) that they are worn over, whose
    unit normals are `normals`; a vertex that is its own inner one stays."""
    normal = take(normals, inner)
    offset = minus(x, take(x, inner))
    height = dot(offset, normal)
    aside = dot(offset, offset) - height * height
    over = inner != jnp.arange(inner.shape[0], dtype=inner.dtype)
    held = over & (aside < _LAYER_RADIUS**2) & (height > -_LAYER_RADIUS)
    return along(x, jnp.where(held, jnp.maximum(gap - height, 0), 0.0), normal)


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
    x: Columns, neighbours: Int[Array, " n"], rest: Columns, free: Float[Array, " n"], distance: float
) -> Columns:
    """Positions moved away from `neighbours` (n,) that are nearer than `distance` metres, but not in the pattern.

    Each of the two goes half the way (each computes its own half), all of it where the other is sewn on (`free` 0).
    """
    offset = minus(x, take(x, neighbours))
    apart = minus(rest, take(rest, neighbours))
    inverse = jax.lax.rsqrt(dot(offset, offset) + 1e-18)
    lacking = jnp.where(dot(apart, apart) > distance**2, jnp.maximum(distance * inverse - 1, 0), 0.0)
    return along(x, lacking * free / jnp.maximum(free + free[neighbours], 1e-9), offset)


def columns(rows: Float[Array, "*s 3"]) -> Columns:
    """Vectors (..., 3) as three arrays (...,) of coordinates."""
    return rows[..., 0], rows[..., 1], rows[..., 2]


def take(x: Columns, index: Int[Array, "*s"]) -> Columns:
    """Vectors by number; all numbers must be within bounds."""
    return jax.tree.map(lambda c: c.at[index].get(mode="promise_in_bounds"), x)


def dot(a: Columns, b: Columns) -> Array:
    """Scalar products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def along(x: Columns, factor: Array, direction: Columns) -> Columns:
    """x + factor direction."""
    return jax.tree.map(lambda c, d: c + factor * d, x, direction)


def minus(a: Columns, b: Columns) -> Columns:
    """a - b."""
    return jax.tree.map(jnp.subtract, a, b)
