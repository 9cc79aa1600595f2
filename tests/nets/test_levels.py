import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import levels, serialization

GRID = 12  # not a power of two
STRIDES = (1, 2, 4)
SIDES = (12, 12, 6, 2)
WIDTHS = (1, 1, 2, 8)  # of a level's voxels, in the first one's


@pytest.fixture(scope="module")
def points():
    """Two hundred points, many of them in one voxel with others."""
    return jnp.asarray(np.random.default_rng(0).uniform(0.2, 1.0, (200, 3)) ** 2, jnp.float32)


def build(points, fill=9.0):
    return jax.jit(lambda p: levels.build(p, GRID, STRIDES, fill))(points)


def voxels_of(points, level):
    """Voxels of the points at a level's resolution."""
    return np.asarray(serialization.voxels(points, GRID)) // WIDTHS[level]


def test_levels_have_the_occupied_voxels_as_numpy_finds_them(points):
    _, built = build(points)
    assert int(built[0].count) == len(points)
    for k, level in enumerate(built):
        occupied = len(np.unique(voxels_of(points, k), axis=0))
        assert int(level.voxels) == occupied
        assert k == 0 or int(level.count) == occupied


def test_points_have_a_parent_in_common_if_and_only_if_they_share_its_voxel(points):
    along_z, built = build(points)
    cluster = np.arange(len(points))
    for k, level in enumerate(built[:-1]):
        cluster = np.asarray(level.parent)[cluster]
        _, expected = np.unique(voxels_of(points[along_z], k + 1), axis=0, return_inverse=True)
        pairs = np.unique(np.stack([cluster, expected]), axis=1)
        assert pairs.shape[1] == len(np.unique(cluster)) == len(np.unique(expected))


def test_voxels_of_the_first_level_join_what_lies_in_one(points):
    along_z, built = build(points)
    _, expected = np.unique(voxels_of(points[along_z], 0), axis=0, return_inverse=True)
    pairs = np.unique(np.stack([built[0].voxel, expected]), axis=1)
    assert pairs.shape[1] == int(built[0].voxels)


@pytest.mark.parametrize("curve", range(4))
def test_every_level_is_ordered_by_its_own_codes_with_padding_last(points, curve):
    """A parent's code is the child's without its last bits: no level needs the points again."""
    along_z, built = build(points)
    cluster, side_bits = np.arange(len(points)), (4, 4, 3, 1)
    for k, level in enumerate(built):
        count = int(level.count)
        voxel = np.zeros((count, 3), np.int32)
        voxel[cluster] = voxels_of(points[along_z], k)
        codes = serialization.codes(jnp.asarray(voxel), side_bits[k], serialization.CURVES[curve])
        order, rank = np.asarray(level.orders[curve]), np.asarray(level.ranks[curve])
        assert (order[:count] < count).all()
        assert (np.diff(np.asarray(codes)[order[:count]]) >= (0 if k == 0 else 1)).all()
        np.testing.assert_array_equal(order[rank], np.arange(len(order)))
        if level.parent is not None:
            cluster = np.asarray(level.parent)[cluster]


def test_clusters_without_room_are_dropped_and_counted(points):
    fill = 0.5
    _, built = build(points, fill)
    room = [min(len(points), int(fill * side**2)) for side in SIDES[1:]]
    occupied = [len(np.unique(voxels_of(points, k), axis=0)) for k in range(4)]
    missing = sum(max(0, n - r) for n, r in zip(occupied, [room[0], *room], strict=True))
    assert missing > 0
    assert int(levels.dropped(points, GRID, STRIDES, fill)) == missing
    assert [level.orders.shape[1] for level in built[1:]] == room
    assert int(built[1].count) == room[0] and int(jnp.max(built[0].parent)) == room[0]
    assert int(levels.dropped(points, GRID, STRIDES, 9.0)) == 0
