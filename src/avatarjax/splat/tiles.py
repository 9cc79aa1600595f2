"""Which Gaussians touch which tile of the image: depth-sorted lists per tile, of a static total capacity."""

from __future__ import annotations

import dataclasses
import functools
import math
import typing

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from avatarjax.splat import columns, sorting
from avatarjax.splat.config import ALPHA_MIN
from avatarjax.splat.project import CHANNELS, DEPTH, EXTENT_X, EXTENT_Y, XX, XY, YY, X, Y


@dataclasses.dataclass(frozen=True)
class TileGrid:
    """An image of width x height pixels cut into tiles; the last ones may hang over the edge.

    With several `shards`, the first takes tile row 0, `shards`, 2 `shards`, ... of the image, the second row 1, and so
    on: rows of a scene that is nowhere equally dense come out about equal. `tiles` and `rows` are those of one shard.
    """

    width: int
    height: int
    tile_width: int
    tile_height: int
    shards: int = 1

    @property
    def columns(self) -> int:
        return -(-self.width // self.tile_width)

    @property
    def image_rows(self) -> int:
        return -(-self.height // self.tile_height)

    @property
    def rows(self) -> int:
        return -(-self.image_rows // self.shards)

    @property
    def tiles(self) -> int:
        return self.columns * self.rows

    def corners(self, shard: Int[Array, ""] | int = 0) -> Float[Array, "t 2"]:
        """x and y of the upper left corners of all tiles of a shard, pixels."""
        tile = jnp.arange(self.tiles, dtype=jnp.int32)
        x = tile % self.columns * self.tile_width
        y = (tile // self.columns * self.shards + shard) * self.tile_height
        return jnp.stack([x, y], axis=1).astype(jnp.float32)

    def assemble(self, blocks: Float[Array, "t c p"]) -> Float[Array, "h w c"]:
        """The image of the blocks, c channels by pixels of a tile, of all shards one after another."""
        channels = blocks.shape[1]
        image = blocks.reshape(self.shards, self.rows, self.columns, channels, self.tile_height, self.tile_width)
        image = image.transpose(1, 0, 4, 2, 5, 3)
        image = image.reshape(self.rows * self.shards * self.tile_height, self.columns * self.tile_width, channels)
        return image[: self.height, : self.width]


class TileLists(typing.NamedTuple):
    """Gaussian indices of all tiles one after another, near to far in each: tile k has ids[starts[k]:ends[k]].

    ids (capacity,), starts (tiles,), ends (tiles,) int32. total: tiles in the bounding boxes of all Gaussians, exact up
    to 2^24, at most 2^30; dropped: how many of them did not fit into the capacity, the farthest Gaussians first.
    """

    ids: Int[Array, " m"]
    starts: Int[Array, " t"]
    ends: Int[Array, " t"]
    total: Int[Array, ""]
    dropped: Int[Array, ""]


class _Boxes(typing.NamedTuple):
    """Bounding boxes in tiles: the first tile, columns, and tiles in all."""

    first_tile: Int[Array, " n"]
    columns: Int[Array, " n"]
    tiles: Int[Array, " n"]


def bin_splats(
    table: Float[Array, "n k"], grid: TileGrid, capacity: int, shard: Int[Array, ""] | int = 0, cull: bool = False
) -> TileLists:
    """Lists of the Gaussians whose bounding box, or with `cull` whose ellipse, meets a tile of a shard.

    Not differentiable. Under `jax.vmap` the scenes are binned one after another.
    """
    one_scene = functools.partial(_bin_splats, grid=grid, capacity=capacity, cull=cull)
    binned = jax.custom_batching.sequential_vmap(one_scene)
    return binned(jax.lax.stop_gradient(table), jnp.int32(shard))


def count_intersections(table: Float[Array, "n k"], grid: TileGrid, shard: Int[Array, ""] | int = 0) -> Int[Array, ""]:
    """Number of tiles in the bounding boxes of all Gaussians, exact up to 2^24, at most 2^30."""
    tiles = _boxes(table, grid, jnp.int32(shard)).tiles
    return sorting.exclusive_sum(tiles)[-1] + tiles[-1]


def _bin_splats(
    table: Float[Array, "n k"], shard: Int[Array, ""], *, grid: TileGrid, capacity: int, cull: bool
) -> TileLists:
    n = table.shape[0]
    boxes = _boxes(table, grid, shard)
    order = sorting.depth_order(table[:, DEPTH], boxes.tiles > 0)
    first_tile, across, tiles = columns.split(columns.take(columns.join(list(boxes)), order))
    starts = sorting.exclusive_sum(tiles)
    total = starts[-1] + tiles[-1]
    # One list entry per tile of a box: mark where each Gaussian's entries start, and count marks to know whose they
    # are.
    marks = jnp.zeros(capacity, jnp.int32).at[jnp.where(tiles > 0, starts, capacity)].add(1, mode="drop")
    owners = jnp.clip(sorting.exclusive_sum(marks) + marks - 1, 0, n - 1)
    layout = sorting.Columns.of(capacity, sorting.KEY_COLUMNS)
    entry = columns.take(columns.join([starts, first_tile, across, order]), layout.lay(owners, 0))
    start, first_tile, across, ids = (entry[..., k] for k in range(4))
    within = layout.elements - start
    # Integer division is slow on CPU; the half keeps the rounding of the float quotient away from the integers.
    row = ((within.astype(jnp.float32) + 0.5) / across.astype(jnp.float32)).astype(jnp.int32)
    tile = first_tile + row * grid.columns + within - row * across
    used = layout.elements < jnp.minimum(total, capacity)
    if cull:
        used &= _reached(table, ids, tile, grid, shard)
    tile = columns.materialize(jnp.where(used, tile, grid.tiles))
    ids, starts, ends = sorting.group_by_key(tile, ids, grid.tiles)
    return TileLists(ids, starts, ends, total, jnp.maximum(total - capacity, 0))


def _boxes(table: Float[Array, "n k"], grid: TileGrid, shard: Int[Array, ""]) -> _Boxes:
    x0, x1 = _tile_range(table[:, X], table[:, EXTENT_X], grid.tile_width, grid.columns)
    y0, y1 = _tile_range(table[:, Y], table[:, EXTENT_Y], grid.tile_height, grid.image_rows)
    # Of the rows of the image, one in `shards` is this shard's.
    y0, y1 = ((y - shard + grid.shards - 1) // grid.shards for y in (y0, y1))
    return _Boxes(
        first_tile=y0 * grid.columns + x0,
        columns=jnp.maximum(x1 - x0, 1),
        tiles=jnp.where(table[:, EXTENT_X] > 0, (x1 - x0) * (y1 - y0), 0),
    )


def _tile_range(
    center: Float[Array, " n"], extent: Float[Array, " n"], size: int, tiles: int
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """First and one past the last tile with a pixel centre within `extent` of `center`, both in pixels."""
    first = jnp.clip(jnp.ceil((center - extent + 0.5) / size) - 1, 0, tiles).astype(jnp.int32)
    stop = jnp.clip(jnp.floor((center + extent - 0.5) / size) + 1, 0, tiles).astype(jnp.int32)
    return first, jnp.maximum(stop, first)


def _reached(
    table: Float[Array, "n k"], ids: Int[Array, "r c"], tile: Int[Array, "r c"], grid: TileGrid, shard: Int[Array, ""]
) -> Bool[Array, "r c"]:
    """Whether the ellipse within which a Gaussian counts meets the rectangle of a tile's pixel centres.

    The largest value of a concave quadratic form over a rectangle is on the sides that face its centre, if that is
    outside.
    """
    # Divisions are made for each Gaussian, of which there are fewer than entries.
    ratios = [-0.5 * table[:, XY] / table[:, XX], -0.5 * table[:, XY] / table[:, YY]]
    entry = columns.materialize(columns.take(columns.join([*columns.split(table[:, :CHANNELS]), *ratios]), ids))
    x, y, xx, xy, yy, log2_opacity, ratio_x, ratio_y = (entry[..., k] for k in range(CHANNELS + 2))
    row = ((tile.astype(jnp.float32) + 0.5) * (1 / grid.columns)).astype(jnp.int32)
    corner_x = ((tile - row * grid.columns) * grid.tile_width).astype(jnp.float32)
    corner_y = ((row * grid.shards + shard) * grid.tile_height).astype(jnp.float32)
    x0, y0 = corner_x + 0.5 - x, corner_y + 0.5 - y
    x1, y1 = x0 + (grid.tile_width - 1), y0 + (grid.tile_height - 1)
    side_x, side_y = jnp.clip(0.0, x0, x1), jnp.clip(0.0, y0, y1)
    along_x, along_y = jnp.clip(ratio_x * side_y, x0, x1), jnp.clip(ratio_y * side_x, y0, y1)

    def logarithm(dx, dy):
        return xx * dx * dx + xy * dx * dy + yy * dy * dy

    # A little less than ALPHA_MIN, for the rounding of both.
    nearest = jnp.maximum(logarithm(side_x, along_y), logarithm(along_x, side_y))
    return log2_opacity + 0.999 * nearest >= math.log2(ALPHA_MIN) - 0.001
