"""Which Gaussians touch which tile of the image: depth-sorted lists per tile, of a static total capacity."""

from __future__ import annotations

import dataclasses
import functools
import math
import typing

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.splat import sorting
from avatarjax.splat.config import ALPHA_MIN
from avatarjax.splat.project import Splats


@dataclasses.dataclass(frozen=True)
class TileGrid:
    """An image of width x height pixels cut into tiles; the last ones may hang over the edge."""

    width: int
    height: int
    tile_width: int
    tile_height: int

    @property
    def columns(self) -> int:
        return -(-self.width // self.tile_width)

    @property
    def rows(self) -> int:
        return -(-self.height // self.tile_height)

    @property
    def tiles(self) -> int:
        return self.columns * self.rows

    @property
    def tile_pixels(self) -> int:
        return self.tile_width * self.tile_height

    def pixel_centers(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y (tile_pixels,) of the pixel centres of a tile, relative to its corner."""
        index = np.arange(self.tile_pixels)
        return index % self.tile_width + 0.5, index // self.tile_width + 0.5

    def corners(self, tiles: Int[Array, " l"]) -> tuple[Float[Array, " l"], Float[Array, " l"]]:
        """x and y of the upper left corners of tiles, pixels."""
        x, y = (tiles % self.columns) * self.tile_width, (tiles // self.columns) * self.tile_height
        return x.astype(jnp.float32), y.astype(jnp.float32)

    def assemble(self, blocks: Float[Array, "t c p"]) -> Float[Array, "h w c"]:
        """The image of per-tile blocks of c channels by tile_pixels."""
        channels = blocks.shape[1]
        image = blocks.reshape(self.rows, self.columns, channels, self.tile_height, self.tile_width)
        image = image.transpose(0, 3, 1, 4, 2)
        image = image.reshape(self.rows * self.tile_height, self.columns * self.tile_width, channels)
        return image[: self.height, : self.width]


class TileLists(typing.NamedTuple):
    """Gaussian indices of all tiles one after another, near to far in each: tile k has ids[starts[k]:ends[k]].

    ids (capacity,), starts (tiles,), ends (tiles,) int32. total: intersections of the scene, exact up to 2^24, at
    most 2^30; dropped: how many of them did not fit into the capacity, the farthest Gaussians first.
    """

    ids: Int[Array, " m"]
    starts: Int[Array, " t"]
    ends: Int[Array, " t"]
    total: Int[Array, ""]
    dropped: Int[Array, ""]


class _Footprints(typing.NamedTuple):
    first_tile: Int[Array, " n"]
    columns: Int[Array, " n"]
    tiles: Int[Array, " n"]


def bin_splats(splats: Splats, grid: TileGrid, capacity: int) -> TileLists:
    """Lists of the Gaussians that reach ALPHA_MIN within the bounding box of a tile. Not differentiable.

    Under `jax.vmap` the scenes are binned one after another.
    """
    binned = jax.custom_batching.sequential_vmap(functools.partial(_bin_splats, grid=grid, capacity=capacity))
    return binned(jax.lax.stop_gradient(splats))


def count_intersections(splats: Splats, grid: TileGrid) -> Int[Array, ""]:
    """Number of (Gaussian, tile) intersections, exact up to 2^24, at most 2^30."""
    tiles = _footprints(splats, grid).tiles
    return sorting.exclusive_sum(tiles)[-1] + tiles[-1]


def _bin_splats(splats: Splats, *, grid: TileGrid, capacity: int) -> TileLists:
    n = splats.depth.shape[0]
    footprints = _footprints(splats, grid)
    order = sorting.depth_order(splats.depth, footprints.tiles > 0)
    sorted_footprints = jnp.stack(footprints, axis=1)[order]
    first_tile, columns, tiles = (sorted_footprints[:, k] for k in range(3))
    starts = sorting.exclusive_sum(tiles)
    total = starts[-1] + tiles[-1]
    # One list entry per intersection: mark where each Gaussian's entries start, and count marks to know whose they are.
    marks = jnp.zeros(capacity, jnp.int32).at[jnp.where(tiles > 0, starts, capacity)].add(1, mode="drop")
    owners = jnp.clip(sorting.exclusive_sum(marks) + marks - 1, 0, n - 1)
    entry = jnp.stack([starts, first_tile, columns, order], axis=1)[owners]
    start, first_tile, columns, ids = (entry[:, k] for k in range(4))
    entries = jnp.arange(capacity, dtype=jnp.int32)
    within = entries - start
    # Integer division is slow on CPU; the half keeps the rounding of the float quotient away from the integers.
    row = ((within.astype(jnp.float32) + 0.5) / columns.astype(jnp.float32)).astype(jnp.int32)
    tile = first_tile + row * grid.columns + within - row * columns
    tile = jnp.where(entries < total, tile, grid.tiles)
    ids, starts, ends = sorting.group_by_key(tile, ids, grid.tiles)
    return TileLists(ids, starts, ends, total, jnp.maximum(total - capacity, 0))


def _footprints(splats: Splats, grid: TileGrid) -> _Footprints:
    # alpha >= ALPHA_MIN inside an ellipse of this many standard deviations, squared.
    reach = jnp.where(splats.valid, 2 * (splats.log_opacity - math.log(ALPHA_MIN)), 0.0)
    # Validity goes into the extents, and is read off them: XLA keeps square roots, but computes what is cheap, such as
    # the whole projection, again for each gathered element.
    extent_x, extent_y = (jnp.sqrt(jnp.maximum(reach, 0.0) * v) for v in (splats.variance_x, splats.variance_y))
    x0, x1 = _tile_range(splats.x, extent_x, grid.tile_width, grid.columns)
    y0, y1 = _tile_range(splats.y, extent_y, grid.tile_height, grid.rows)
    return _Footprints(
        first_tile=y0 * grid.columns + x0,
        columns=jnp.maximum(x1 - x0, 1),
        tiles=jnp.where(extent_x > 0, (x1 - x0) * (y1 - y0), 0),
    )


def _tile_range(
    center: Float[Array, " n"], extent: Float[Array, " n"], size: int, tiles: int
) -> tuple[Int[Array, " n"], Int[Array, " n"]]:
    """First and one past the last tile with a pixel centre within `extent` of `center`, both in pixels."""
    first = jnp.clip(jnp.ceil((center - extent + 0.5) / size) - 1, 0, tiles).astype(jnp.int32)
    stop = jnp.clip(jnp.floor((center + extent - 0.5) / size) + 1, 0, tiles).astype(jnp.int32)
    return first, jnp.maximum(stop, first)
