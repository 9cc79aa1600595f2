"""The resolutions at which a point transformer sees a cloud: serialised pooling with static shapes (PTv3, UNICA C.1).

Codes along a curve are hierarchical: without its last three bits a code is that of the voxel twice as wide. Points that
agree in the bits that are left form one cluster, on every curve the same ones. How many there are depends on the pose,
so a level has room for a fixed number and counts how many of its places are taken; clusters beyond that are dropped,
and `dropped` says how many.
"""

from __future__ import annotations

import itertools
import math
import typing

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from avatarjax.nets import serialization, submanifold


class Level(typing.NamedTuple):
    """One resolution: n places along the z curve, of which the first `count` () hold a point.

    orders (4, n): the points in the order of each of `serialization.CURVES`, ranks (4, n): where on it each one stands.
    voxel (n,): the row of each point's voxel, None where it is its own; neighbours (m, 27): the voxels around each of
    the first `voxels` () ones, as `submanifold.neighbours`. parent (n,): each point's cluster on the next level. A row
    past the end stands for none.
    """

    count: Int[Array, ""]
    orders: Int[Array, "4 n"]
    ranks: Int[Array, "4 n"]
    voxel: Int[Array, "n"] | None
    neighbours: Int[Array, "m 27"]
    voxels: Int[Array, ""]
    parent: Int[Array, "n"] | None


def build(
    points: Float[Array, "n 3"], grid: int, strides: tuple[int, ...], fill: float
) -> tuple[Int[Array, "n"], list[Level]]:
    """The order of points in [0, 1]^3 along the z curve, in which the first level has them, and all levels.

    The first has a grid^3 grid, each further one a `stride` (a power of two) times as wide. A level has room for as
    many voxels as `fill` times a face of its grid has, or as the level before it has points.
    """
    bits = max(1, (grid - 1).bit_length())
    voxel = serialization.voxels(points, grid)
    codes = jnp.stack([serialization.codes(voxel, bits, curve) for curve in serialization.CURVES])
    along_z = jnp.argsort(codes[0])
    codes, voxel = codes[:, along_z], voxel[along_z]

    levels, count = [], jnp.asarray(len(points))
    sides = _sides(grid, strides)
    for k, side in enumerate(sides):
        n = len(voxel)
        # Points come along the z curve already.
        orders = jnp.concatenate([jnp.arange(n)[None], jnp.argsort(codes[1:], axis=1)])
        ranks = jnp.zeros_like(orders).at[jnp.arange(len(orders))[:, None], orders].set(jnp.arange(n)[None])
        if k == 0:  # only here may points share a voxel
            own, head, voxels = _clusters(codes[0], count, _room(side, fill, n))
        else:
            own, head, voxels = None, jnp.arange(n), count
        level = Level(count, orders, ranks, own, submanifold.neighbours(voxel[head], voxels, side), voxels, None)
        if k < len(strides):
            shift = _halvings(strides[k])
            parent, head, count = _clusters(codes[0] >> 3 * shift, count, _room(sides[k + 1], fill, n))
            level, voxel = level._replace(parent=parent), voxel[head] >> shift
            # Padding comes last on every curve.
            codes = jnp.where((jnp.arange(len(head)) < count)[None], codes[:, head] >> 3 * shift, 1 << 30)
        levels.append(level)
    return along_z, levels


def dropped(points: Float[Array, "n 3"], grid: int, strides: tuple[int, ...], fill: float) -> Int[Array, ""]:
    """How many clusters found no room, on all levels together; 0, or a larger `fill` is needed."""
    bits = max(1, (grid - 1).bit_length())
    code = jnp.sort(serialization.codes(serialization.voxels(points, grid), bits, "z"))
    total, room, shift = jnp.asarray(0), len(points), 0
    for side, stride in zip(_sides(grid, strides), (*strides, 1), strict=True):
        room = _room(side, fill, room)
        total += jnp.maximum(jnp.sum(_starts(code >> 3 * shift)) - room, 0)
        shift += _halvings(stride)
    return total


def _clusters(code: Int[Array, "n"], count: Int[Array, ""], room: int):
    """Cluster (n,) of each of the first `count` points, which ascend by code: `room` for none; the first point (room,)
    of each cluster, and the number () of clusters."""
    valid = jnp.arange(len(code)) < count
    starts = _starts(code) & valid
    cluster = jnp.where(valid, jnp.minimum(jnp.cumsum(starts) - 1, room), room)
    head = jnp.nonzero(starts, size=room, fill_value=0)[0]
    return cluster, head, jnp.minimum(jnp.sum(starts), room)


def _starts(code: Int[Array, "n"]) -> Bool[Array, "n"]:
    """Where a new value begins."""
    return jnp.concatenate([jnp.ones(1, bool), code[1:] != code[:-1]])


def _sides(grid: int, strides: tuple[int, ...]) -> list[int]:
    """Voxels along an edge of each level's grid."""
    return list(itertools.accumulate(strides, lambda side, stride: -(-side // stride), initial=grid))


def _halvings(stride: int) -> int:
    return stride.bit_length() - 1


def _room(side: int, fill: float, limit: int) -> int:
    return min(limit, math.ceil(fill * side * side))
