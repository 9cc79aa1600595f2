"""Grids: where voxels lie, which are a surface, and the Gaussians that come of them."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from avatarjax.smad import voxels


def test_a_grid_holds_its_box_in_cubes():
    grid = voxels.fill((-1, 0, 2), (1, 3, 2.5), 12)
    assert grid.shape == (8, 12, 2)
    np.testing.assert_allclose(grid.edge, 0.25)
    np.testing.assert_allclose(grid.high, (1, 3, 2.5), atol=1e-6)
    np.testing.assert_allclose(grid.centres[0], (-0.875, 0.125, 2.125), atol=1e-6)
    np.testing.assert_allclose(grid.centres[1] - grid.centres[0], (0, 0, 0.25), atol=1e-6)


@pytest.mark.parametrize("high", [(1, 0, 1), (1, -1, 1), (np.nan, 1, 1)])
def test_boxes_without_volume_are_refused(high):
    with pytest.raises(ValueError, match="a corner below another"):
        voxels.fill((0, 0, 0), high, 8)


def test_lookup_finds_the_voxel_and_nothing_outside():
    grid = voxels.fill((-1, 0, 2), (1, 3, 2.5), 12)
    values = jnp.arange(1.0, 193.0).reshape(grid.shape)
    np.testing.assert_array_equal(voxels.lookup(grid, values, grid.centres), values.reshape(-1))
    outside = jnp.asarray([[-1.01, 1, 2.1], [0, 3.01, 2.1], [0, 1, 9]])
    np.testing.assert_array_equal(voxels.lookup(grid, values, outside), 0)
    pairs = jnp.stack([values, -values], -1)
    np.testing.assert_array_equal(voxels.lookup(grid, pairs, grid.centres[:5])[:, 1], -values.reshape(-1)[:5])


def test_a_surface_has_an_empty_voxel_or_the_border_behind_a_face():
    occupied = np.zeros((7, 7, 7), bool)
    occupied[:5, 1:6, 1:6] = True
    assert np.argwhere(occupied & ~voxels.surface(occupied)).tolist() == [
        [x, y, z] for x in (1, 2, 3) for y in (2, 3, 4) for z in (2, 3, 4)
    ]


def sphere(count=4000):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_gaussians_are_about_as_many_as_asked_for_and_lie_where_the_points_lie():
    points = sphere()
    cloud = voxels.to_gaussians(points, 0.5 + 0.5 * points, 600, 0.7)
    assert abs(len(cloud) - 600) < 60
    means = np.asarray(cloud.means)
    assert np.abs(np.linalg.norm(means, axis=1) - 1).max() < 0.03
    np.testing.assert_allclose(cloud.colors, 0.5 + 0.5 * means, atol=1e-5)
    np.testing.assert_allclose(cloud.opacities, 0.7, rtol=1e-5)
    np.testing.assert_array_equal(cloud.quats, np.tile([1, 0, 0, 0], (len(cloud), 1)))


def test_gaussians_are_round_and_as_wide_as_they_lie_apart():
    cloud = voxels.to_gaussians(sphere(), np.zeros((4000, 3)), 10_000, 0.7)
    assert len(cloud) == 4000
    near, _ = cKDTree(np.asarray(cloud.means)).query(np.asarray(cloud.means), k=4)
    assert np.ptp(np.asarray(cloud.log_scales), axis=1).max() == 0
    np.testing.assert_allclose(cloud.scales[:, 0], 0.45 * np.sqrt((near[:, 1:] ** 2).mean(1)), rtol=1e-3)


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="3 voxels are no surface"):
        voxels.to_gaussians(np.eye(3), np.eye(3), 10, 0.5)
