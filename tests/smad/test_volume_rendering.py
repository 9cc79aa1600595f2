"""Volume rendering against closed forms and a float64 loop; where rays and samples lie."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import cameras
from avatarjax.smad import volume_rendering as volume
from avatarjax.smad import voxels
from avatarjax.smad.volume_rendering import Rays

GRID = voxels.fill((-0.4, -0.6, -0.3), (0.4, 0.6, 0.5), 12)


def random_rays(count=40, seed=0):
    rng = np.random.default_rng(seed)
    origins = 2 * rng.normal(size=(count, 3))
    directions = 0.3 * rng.normal(size=(count, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    o, d = jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32)
    return Rays(o, d, *volume.crossing(o, d, GRID.low, GRID.high))


def reference(density, colors, lengths):
    """Front to back in float64, interval by interval."""
    density, colors, lengths = (np.asarray(x, np.float64) for x in (density, colors, lengths))
    color, through = np.zeros((len(density), 3)), np.ones(len(density))
    for k in range(density.shape[1]):
        alpha = 1 - np.exp(-density[:, k] * lengths[:, k])
        color += (through * alpha)[:, None] * colors[:, k]
        through *= 1 - alpha
    return color, 1 - through


def intervals(count=30, samples=17, seed=0):
    rng = np.random.default_rng(seed)
    arrays = rng.exponential(30, (count, samples)), rng.random((count, samples, 3)), 0.1 * rng.random((count, samples))
    return [jnp.asarray(x, jnp.float32) for x in arrays]


def test_light_is_that_of_a_loop_from_front_to_back():
    density, colors, lengths = intervals()
    light = volume.composite(density, colors, lengths)
    color, alpha = reference(density, colors, lengths)
    np.testing.assert_allclose(light.color, color, atol=2e-6)
    np.testing.assert_allclose(light.alpha, alpha, atol=2e-6)
    np.testing.assert_allclose(light.weights.sum(1), light.alpha, rtol=1e-6)


def test_what_is_opaque_hides_what_is_behind():
    colors = jnp.asarray([[[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]])
    light = volume.composite(jnp.asarray([[0.0, 1e4, 1e4]]), colors, jnp.full((1, 3), 0.1))
    np.testing.assert_allclose(light.color, [[0, 1, 0]])
    half = volume.composite(jnp.asarray([[np.log(2), 1e4, 0.0]]), colors, jnp.ones((1, 3)))
    np.testing.assert_allclose(half.color, [[0.5, 0.5, 0]], rtol=1e-6)


@pytest.mark.parametrize("seed", [None, 3])
@pytest.mark.parametrize("guided", [False, True], ids=["even", "guided"])
def test_a_slab_takes_light_by_its_depth(seed, guided):
    """Constant density in the box: alpha = 1 - exp(-density d), wherever the samples lie."""
    rays = random_rays()
    key = None if seed is None else jax.random.key(seed)
    wanted = jnp.asarray(np.random.default_rng(1).random((40, 9)) + 0.1, jnp.float32) if guided else None
    distances, lengths = volume.stratify(rays, 16, key, wanted)
    density = jnp.full(distances.shape, 2.5)
    light = volume.composite(density, jnp.ones((*distances.shape, 3)), lengths)
    span = np.asarray(rays.far - rays.near, np.float64)
    assert (span > 0).sum() > 20
    np.testing.assert_allclose(light.alpha, 1 - np.exp(-2.5 * span), atol=2e-6)
    np.testing.assert_allclose(light.color, np.repeat(np.asarray(light.alpha)[:, None], 3, 1), atol=2e-6)


def test_gradients_are_finite_where_nothing_or_everything_is():
    colors, lengths = jnp.ones((1, 4, 3)), jnp.full((1, 4), 0.1)
    for density in ([0.0, 0.0, 0.0, 0.0], [0.0, 1e9, 5.0, 1e9]):
        value = lambda d: jnp.sum(volume.composite(d, colors, lengths).color)  # noqa: E731
        assert np.isfinite(jax.grad(value)(jnp.asarray([density]))).all()


def test_gradients_are_those_of_float64():
    density, colors, lengths = intervals(3, 6)
    weights = np.random.default_rng(2).normal(size=(3, 3))
    slope = jax.grad(lambda d: jnp.sum(jnp.asarray(weights, jnp.float32) * volume.composite(d, colors, lengths).color))
    found, step = np.asarray(slope(density)), 1e-5
    base = np.asarray(density, np.float64)
    for i, j in ((0, 0), (1, 3), (2, 5)):
        moved = [base.copy(), base.copy()]
        moved[0][i, j] += step
        moved[1][i, j] -= step
        up, down = ((weights * reference(d, colors, lengths)[0]).sum() for d in moved)
        np.testing.assert_allclose(found[i, j], (up - down) / (2 * step), rtol=1e-3, atol=1e-6)


def test_rays_are_in_the_box_between_near_and_far_only():
    rays = random_rays(200)
    low, high = np.asarray(GRID.low), np.asarray(GRID.high)
    for k in np.linspace(0, 5, 301):
        place = np.asarray(rays.origins + k * rays.directions)
        inside = ((place > low) & (place < high)).all(1)
        between = (k > np.asarray(rays.near)) & (k < np.asarray(rays.far))
        rim = np.minimum(abs(k - np.asarray(rays.near)), abs(k - np.asarray(rays.far))) < 1e-4
        np.testing.assert_array_equal(inside[~rim], between[~rim])


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, -2), (0, 0, 1), (1.7, 2.5)),
        ((0, 0, 0), (0, 1, 0), (0, 0.6)),
        ((0, 0, 2), (0, 0, 1), (0, 0)),
        ((0.5, 0, -2), (0, 0, 1), (0, 0)),
    ],
    ids=["along an axis", "from inside", "away", "beside"],
)
def test_special_rays(origin, direction, expected):
    o, d = (jnp.asarray([x], jnp.float32) for x in (origin, direction))
    near, far = volume.crossing(o, d, GRID.low, GRID.high)
    np.testing.assert_allclose((near[0], far[0]), expected, atol=1e-6)


def test_samples_lie_in_their_own_intervals():
    rays = random_rays()
    distances, lengths = volume.stratify(rays, 8, jax.random.key(0))
    edges = np.asarray(rays.near)[:, None] + np.concatenate([np.zeros((40, 1)), np.cumsum(lengths, 1)], 1)
    assert (distances >= edges[:, :-1] - 1e-6).all() and (distances <= edges[:, 1:] + 1e-6).all()
    np.testing.assert_allclose(edges[:, -1], rays.far, atol=1e-5)


def test_samples_go_where_they_are_wanted():
    """Nine of ten shares of a part: nine of ten samples in it."""
    rays = Rays(jnp.zeros((1, 3)), jnp.asarray([[0, 0, 1.0]]), jnp.ones(1), jnp.full(1, 3.0))
    distances, lengths = volume.stratify(rays, 40, None, jnp.asarray([[1.0, 18.0, 0.5, 0.5]]))
    inside = np.asarray((distances > 1.5) & (distances < 2.0))
    assert inside.sum() == 36
    np.testing.assert_allclose(lengths[inside], 0.5 / 36, rtol=1e-4)


def test_a_camera_sees_the_points_of_a_ray_in_its_pixel():
    camera = cameras.look_at((1, 0.5, 2), (0, 0.1, 0), width=20, height=10)
    camera = camera.replace(intrinsics=camera.intrinsics.at[0, 1].set(1.5))
    rays = volume.pixel_rays(camera, GRID)
    row, column = 6, 11
    k = row * 20 + column
    assert rays.far[k] > rays.near[k]
    place, _ = cameras.project(camera, rays.origins[k : k + 1] + 1.7 * rays.directions[k : k + 1])
    np.testing.assert_allclose(place[0], (column + 0.5, row + 0.5), atol=1e-4)
    np.testing.assert_allclose(rays.origins[k], camera.position, atol=1e-6)
