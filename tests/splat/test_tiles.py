"""The lists of the tiles against every Gaussian and every pixel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.splat import SplatConfig
from avatarjax.splat.project import DEPTH, EXTENT_X, LOG2_OPACITY, XX, XY, YY, X, Y, project
from avatarjax.splat.tiles import TileGrid, bin_splats, count_intersections
from tests.splat.scenes import front_camera, random_gaussians

CAPACITY = 4000


def scene():
    """Long, thin Gaussians, whose boxes have empty corners."""
    gaussians = random_gaussians(n=50, size=0.05)
    stretch = jnp.asarray([[1.5, 0.0, -1.0]])
    return gaussians.replace(log_scales=gaussians.log_scales + stretch), front_camera(45, 30)


def lists_of(shards=1, shard=0, cull=False):
    gaussians, camera = scene()
    grid = TileGrid(camera.width, camera.height, 8, 4, shards)
    table, _ = project(gaussians, gaussians.colors, camera, SplatConfig())
    lists = jax.jit(lambda x: bin_splats(x, grid, CAPACITY, shard, cull))(table)
    ids, starts, ends = (np.asarray(x) for x in lists[:3])
    return table, grid, lists, [ids[a:b].tolist() for a, b in zip(starts, ends, strict=True)]


def visible_in(table, grid, shards=1, shard=0):
    """Sets of the Gaussians that reach ALPHA_MIN at a pixel centre of each tile, in float64."""
    table = np.asarray(table, np.float64)
    sets = []
    for corner in np.asarray(grid.corners(shard), np.float64):
        x, y = np.meshgrid(corner[0] + np.arange(8) + 0.5, corner[1] + np.arange(4) + 0.5)
        inside = (x < grid.width) & (y < grid.height)
        dx, dy = (p.reshape(1, -1) - table[:, [k]] for p, k in ((x, X), (y, Y)))
        log2 = table[:, [XX]] * dx**2 + table[:, [XY]] * dx * dy + table[:, [YY]] * dy**2 + table[:, [LOG2_OPACITY]]
        hit = (log2 >= np.log2(1 / 255)) & inside.reshape(1, -1) & (table[:, [EXTENT_X]] > 0)
        sets.append(set(np.flatnonzero(hit.any(axis=1))))
    return sets


@pytest.mark.parametrize("cull", [False, True])
def test_every_gaussian_is_in_the_list_of_every_tile_it_shows_in(cull):
    table, grid, _, lists = lists_of(cull=cull)
    assert all(seen <= set(ids) for seen, ids in zip(visible_in(table, grid), lists, strict=True))


def test_culling_of_ellipses_leaves_little_that_does_not_show():
    table, grid, _, boxes = lists_of()
    _, _, _, culled = lists_of(cull=True)
    count = [sum(map(len, lists)) for lists in (visible_in(table, grid), culled, boxes)]
    assert count[0] <= count[1] < 1.15 * count[0] < count[2]


def test_lists_are_sorted_by_depth():
    table, _, _, lists = lists_of()
    depth = np.asarray(table[:, DEPTH])
    assert all(np.all(np.diff(depth[ids]) >= 0) for ids in lists)


def test_total_is_the_number_of_entries():
    table, grid, lists, entries = lists_of()
    assert int(lists.total) == int(count_intersections(table, grid)) == sum(map(len, entries))


def test_shards_take_the_rows_of_the_image_in_turn():
    _, whole_grid, _, whole = lists_of()
    rows = {}
    for shard in range(3):
        _, grid, _, lists = lists_of(shards=3, shard=shard)
        for row in range(grid.rows):
            rows[row * 3 + shard] = lists[row * grid.columns : (row + 1) * grid.columns]
    expected = [whole[r * whole_grid.columns : (r + 1) * whole_grid.columns] for r in range(whole_grid.rows)]
    assert [rows[r] for r in range(whole_grid.rows)] == expected


@pytest.mark.parametrize("shards", [1, 2, 3])
def test_image_is_assembled_from_the_tiles_at_their_corners(shards):
    grid = TileGrid(21, 14, 8, 4, shards)
    corners = np.concatenate([np.asarray(grid.corners(k)) for k in range(shards)])
    index = np.arange(32)
    x, y = corners[:, :1] + index % 8, corners[:, 1:] + index // 8
    image = grid.assemble(jnp.asarray(np.stack([x, y], axis=1), jnp.float32))
    expected = np.stack(np.meshgrid(np.arange(21), np.arange(14)), axis=-1)
    np.testing.assert_array_equal(image, expected)
