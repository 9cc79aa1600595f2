"""The deformable radiance field: what it is before training, its average, what it learns, and what comes out of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import radiance_field as field
from avatarjax.smad import train_radiance_field as training
from avatarjax.smad import views, voxels
from avatarjax.smad import volume_rendering as volume
from avatarjax.smad.hull import Hull
from avatarjax.smad.radiance_field import FieldConfig
from avatarjax.smad.volume_rendering import Rays
from avatarjax.train import read_metrics
from tests.parameters import random_like
from tests.smad import turning

# Compiled as a whole these are faster, also for a single call.
sample, canonical, render, time_average = (
    jax.jit(f, static_argnums=0) for f in (field.sample, field.canonical, field.render, field.time_average)
)
TINY = FieldConfig(cells=8, width=8, layers=2, point_bands=2, time_bands=2, samples=12, probes=8, gaussians=500)
GRID = voxels.fill((-0.4, -0.6, -0.3), (0.4, 0.6, 0.5), 12)


NOWHERE = Hull(GRID, jnp.zeros(GRID.shape, bool))


@pytest.fixture(scope="module")
def fresh():
    """The field of an empty hull."""
    return field.init(TINY, NOWHERE, jax.random.key(0))


@pytest.fixture(scope="module")
def some(fresh):
    """Parameters with which everything does something."""
    params = random_like(fresh, 0, 0.5)
    return {**params, "grid": 0.1 * params["grid"]}


def places(count=6, samples=5, seed=0):
    low, high = np.asarray(GRID.low), np.asarray(GRID.high)
    share = np.random.default_rng(seed).random((count, samples, 3))
    return jnp.asarray(low + share * (high - low), jnp.float32), jnp.linspace(0.0, 1.0, count)


def test_before_training_it_is_at_rest_and_nearly_empty(fresh):
    points, times = places()
    np.testing.assert_array_equal(canonical(TINY, fresh, GRID, points, times), points)
    density, colors = sample(TINY, fresh, GRID, points, times)
    np.testing.assert_allclose(density, -np.log(0.998) / float(GRID.edge), rtol=1e-4)
    np.testing.assert_allclose(colors, 0.5)


def test_training_starts_from_a_mist_in_the_hull():
    occupied = jnp.asarray(np.random.default_rng(0).random(GRID.shape) < 0.5)
    params = field.init(TINY, Hull(GRID, occupied), jax.random.key(0))
    density, _ = sample(TINY, params, GRID, GRID.centres[None], jnp.zeros(1))
    taken = 1 - np.exp(-np.asarray(density) * float(GRID.edge))
    np.testing.assert_allclose(taken[0], np.where(np.asarray(occupied).reshape(-1), 0.03, 0.002), rtol=1e-3)


def test_values_are_interpolated_before_the_activation(fresh):
    """A field that is linear in space is exact between the middles of voxels."""
    slope, rng = np.array([0.02, -0.03, 0.01]), np.random.default_rng(1)
    middles = np.asarray(GRID.centres, np.float64)
    values = np.zeros((*GRID.shape, 4), np.float32)
    values[..., 0] = (middles @ slope).reshape(GRID.shape)
    low, high = middles[0], middles[-1]
    points = low + rng.random((4, 9, 3)) * (high - low)
    found, _ = sample(TINY, {**fresh, "grid": jnp.asarray(values)}, GRID, jnp.float32(points), jnp.zeros(4))
    expected = np.log1p(np.exp(40 * points @ slope) * np.expm1(-np.log(0.998))) / float(GRID.edge)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_there_is_nothing_outside_of_the_box(fresh):
    points = jnp.asarray([[[0.41, 0, 0], [0, -0.61, 0], [0, 0, 0.51], [0, 0, 0.49]]])
    density, _ = sample(TINY, fresh, GRID, points, jnp.zeros(1))
    np.testing.assert_array_equal(density[0, :3], 0)
    assert density[0, 3] > 0


def test_points_move_in_time_within_their_bound(some):
    points, _ = places()
    moved = [np.asarray(canonical(TINY, some, GRID, points, jnp.full(6, t)) - points) for t in (0.1, 0.8)]
    assert np.abs(moved[0] - moved[1]).max() > 1e-3
    assert np.abs(moved).max() <= TINY.offset_bound + 1e-5


def test_a_uniform_field_takes_light_by_the_depth_of_the_box(fresh):
    origins = jnp.asarray([[0.1, 0.2, -2.0], [0.05, -0.1, -2.0]])
    directions = jnp.asarray([[0.0, 0, 1], [0, 0, 1]])
    rays = Rays(origins, directions, *volume.crossing(origins, directions, GRID.low, GRID.high))
    occupied = jnp.asarray(np.random.default_rng(0).random(GRID.shape) < 0.3)
    for key in (None, jax.random.key(1)):
        light = render(TINY, fresh, Hull(GRID, occupied), rays, jnp.zeros(2), key)
        np.testing.assert_allclose(light.alpha, 1 - 0.998 ** (0.8 / float(GRID.edge)), rtol=1e-3)
        np.testing.assert_allclose(light.color, np.repeat(np.asarray(light.alpha)[:, None] / 2, 3, 1), rtol=1e-4)


def test_the_average_is_the_mean_over_times(some):
    times = jnp.asarray([0.0, 0.3, 1.0])
    density, colors = time_average(TINY, some, GRID, times)
    each = [sample(TINY, some, GRID, GRID.centres[None], t[None]) for t in times]
    sigma = np.stack([np.asarray(d[0], np.float64) for d, _ in each])
    seen = np.stack([np.asarray(c[0], np.float64) for _, c in each])
    np.testing.assert_allclose(np.asarray(density).reshape(-1), sigma.mean(0), rtol=1e-4, atol=1e-6)
    expected = (sigma[..., None] * seen).sum(0) / np.maximum(sigma.sum(0), 1e-12)[:, None]
    np.testing.assert_allclose(np.asarray(colors).reshape(-1, 3), expected, atol=1e-4)


def ball(radius=0.25, center=(0.0, 0.0, 0.1)):
    """A red and opaque ball as values of the grid."""
    middles = np.asarray(GRID.centres)
    inside = np.linalg.norm(middles - np.array(center), axis=1) < radius
    values = np.where(inside[:, None], [1.0, 0.2, -0.2, -0.2], [-1.0, 0, 0, 0]).astype(np.float32)
    return jnp.asarray(values.reshape(*GRID.shape, 4)), inside


def test_gaussians_are_the_shell_of_what_is_dense(fresh):
    values, inside = ball()
    cloud = field.extract(TINY, {**fresh, "grid": values}, GRID, jnp.asarray([0.0, 1.0]))
    shell = voxels.surface(inside.reshape(GRID.shape)).reshape(-1)
    np.testing.assert_allclose(cloud.means, np.asarray(GRID.centres)[shell], atol=1e-6)
    np.testing.assert_allclose(cloud.colors, np.tile(1 / (1 + np.exp([-8.0, 8, 8])), (shell.sum(), 1)), atol=1e-4)


def test_a_hollow_body_has_no_inner_wall(fresh):
    values, inside = ball()
    hollow = ball(0.1)[1] & inside
    assert hollow.any()
    emptied = jnp.asarray(np.where(hollow.reshape(*GRID.shape, 1), -1.0, values).astype(np.float32))
    solid, shell = (field.extract(TINY, {**fresh, "grid": v}, GRID, jnp.zeros(1)) for v in (values, emptied))
    np.testing.assert_array_equal(solid.means, shell.means)


def test_nothing_comes_of_an_empty_field(fresh):
    with pytest.raises(ValueError, match=r"as deep as kappa = 0\.3, the deepest 0\.002"):
        field.extract(TINY, fresh, GRID, jnp.zeros(1))


CONFIG = FieldConfig(
    cells=20, width=16, layers=2, point_bands=2, time_bands=3, samples=24, probes=16, rays=256, steps=120, margin=3,
    learning_rate=5e-3, gaussians=1000,
)  # fmt: skip


@pytest.fixture(scope="module")
def film():
    sphere = lambda o, d: turning.ellipsoid(o, d, (0.35, 0.35, 0.35))  # noqa: E731
    return turning.video(sphere, frames=12, size=32)


@pytest.fixture(scope="module")
def trained(film, tmp_path_factory):
    folder = tmp_path_factory.mktemp("field")
    return training.train(film, CONFIG, folder), folder


def test_it_learns_a_sphere(trained):
    records = read_metrics(trained[1] / "radiance_field.jsonl")
    for name in ("photometric", "silhouette"):
        assert records[-1][name] < 0.15 * records[0][name], name


def test_gaussians_lie_on_the_sphere_in_its_colours(trained):
    result, _ = trained
    cloud = field.extract(CONFIG, result.params, result.where.grid, jnp.asarray(result.times))
    means, colors = np.asarray(cloud.means), np.asarray(cloud.colors)
    radius, edge = np.linalg.norm(means, axis=1), float(result.where.grid.edge)
    assert len(cloud) > 200
    seen = np.abs(means[:, 1]) < 0.25
    # The middles of the outermost voxels lie half an edge inside.
    assert np.abs(np.median(radius[seen]) + edge / 2 - 0.35) < edge
    assert np.mean(np.abs(radius[seen] + edge / 2 - 0.35) < 1.5 * edge) > 0.9
    for side, color in ((means[:, 0] > edge, turning.RED), (means[:, 0] < -edge, turning.BLUE)):
        assert np.abs(colors[side & seen] - color / 255).mean() < 0.1


def test_it_draws_the_pictures_it_has_seen(trained, film):
    result, _ = trained
    camera = jax.tree.map(lambda x: x[0], views.of_video(film, np.array([5])))
    rays = volume.pixel_rays(camera, result.where.grid)
    times = jnp.full(len(rays.near), result.times[5])
    light = render(CONFIG, result.params, result.where, rays, times)
    mask = film.masks[5].reshape(-1)
    assert np.abs(np.asarray(light.alpha) - mask).mean() < 0.05
    shown = film.images()[5].reshape(-1, 3)[mask] / 255
    assert np.abs(np.asarray(light.color)[mask] - shown).mean() < 0.1


def test_the_deformation_explains_what_moves(tmp_path):
    """A thing that sways in its body frame: held still, the same field cannot show it."""
    film = turning.video(frames=24, size=32, sway=0.12)
    config = dataclasses.replace(CONFIG, point_bands=1, time_bands=4)
    left = {}
    for bound in (0.3, 1e-6):
        training.train(film, dataclasses.replace(config, offset_bound=bound), tmp_path / str(bound))
        records = read_metrics(tmp_path / str(bound) / "radiance_field.jsonl")[-20:]
        left[bound] = np.mean([r["silhouette"] for r in records])
    assert left[0.3] < 0.6 * left[1e-6]


def test_a_run_goes_on_and_another_seed_is_another_run(trained, film):
    result, folder = trained
    again = training.train(film, CONFIG, folder)
    jax.tree.map(np.testing.assert_array_equal, again.params, result.params)
    with pytest.raises(ValueError, match="masks are empty"):
        training.train(dataclasses.replace(film, mattes=np.zeros_like(film.mattes)), CONFIG, folder)


def test_gradients_are_finite_and_reach_every_parameter(trained, film):
    result, _ = trained
    cameras = views.of_video(film, np.arange(64) % len(film))
    params = random_like(result.params, 0, 0.3)
    params["grid"] = 0.1 * params["grid"]
    rng = np.random.default_rng(0)
    batch = training.RayBatch(
        result.where,
        cameras.world_to_camera,
        cameras.intrinsics,
        jnp.asarray(8 + 16 * rng.random((64, 2)), jnp.float32),
        jnp.linspace(0.0, 1.0, 64),
        jnp.asarray(rng.random((64, 3)), jnp.float32),
        jnp.asarray(rng.random(64) < 0.5),
    )
    slope = jax.jit(jax.grad(lambda p: training.loss(CONFIG, p, jax.random.key(0), batch)[0]))(params)
    for leaf in jax.tree.leaves(slope):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="samples is 0"):
        FieldConfig(samples=0)
    with pytest.raises(ValueError, match=r"kappa is -1\.0"):
        FieldConfig(kappa=-1.0)
