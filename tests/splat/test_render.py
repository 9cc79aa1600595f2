"""The renderer against its float64 reference, and what must hold for any scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import Camera, look_at, orbit, render, rotations
from avatarjax.gaussians import transform
from avatarjax.splat import SplatConfig, required_capacity
from avatarjax.splat.reference import render_reference
from tests.splat.scenes import front_camera, random_gaussians

BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)


@jax.jit
def energy_gradients(gaussians, camera):
    return jax.grad(lambda g, c: jnp.sum(render(g, c).image ** 2), argnums=(0, 1))(gaussians, camera)


def small_scene():
    """One shape for most tests, so that they share compiled programs."""
    return random_gaussians(n=20), front_camera(16, 12)


def to_float64(tree):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), tree)


def reference_image(gaussians, camera, background=0.0):
    with jax.enable_x64(True):
        draw = jax.jit(render_reference)
        output = draw(to_float64(gaussians), to_float64(camera), background=np.asarray(background, np.float64))
        return jax.tree.map(np.asarray, output)


def relative_error(got, expected):
    got, expected = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    return np.linalg.norm(got - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("size", [(37, 23), (1, 1)], ids=str)
def test_image_alpha_and_depth_match_the_float64_reference(size):
    gaussians, camera = random_gaussians(), front_camera(*size)
    output = render(gaussians, camera, background=BACKGROUND)
    expected = reference_image(gaussians, camera, BACKGROUND)
    assert int(output.info.dropped) == 0
    np.testing.assert_allclose(output.image, expected.image, atol=1e-5)
    np.testing.assert_allclose(output.alpha, expected.alpha, atol=1e-5)
    np.testing.assert_allclose(output.depth, expected.depth, atol=2e-4)


def weighted_sum(draw):
    """A scalar of image, alpha and depth with fixed random weights, as a function of everything that has a gradient."""

    def loss(gaussians, camera, background):
        rng = np.random.default_rng(5)
        output = draw(gaussians, camera, background=background)
        results = (output.image, output.alpha, 0.1 * output.depth * output.alpha)
        return sum(jnp.sum(jnp.asarray(rng.normal(size=x.shape), x.dtype) * x) for x in results)

    return loss


@pytest.fixture(scope="module")
def gradients():
    gaussians, camera = random_gaussians(), front_camera(37, 23)
    inputs = (gaussians, camera, jnp.asarray(BACKGROUND))
    got = jax.jit(jax.grad(weighted_sum(render), argnums=(0, 1, 2)))(*inputs)
    with jax.enable_x64(True):
        expected = jax.jit(jax.grad(weighted_sum(render_reference), argnums=(0, 1, 2)))(*to_float64(inputs))
        expected = jax.tree.map(np.asarray, expected)
    return got, expected


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "logit_opacities", "colors"])
def test_gradient_of_the_cloud_matches_the_reference(gradients, name):
    got, expected = gradients
    assert relative_error(getattr(got[0], name), getattr(expected[0], name)) < 1e-4


@pytest.mark.parametrize("name", ["world_to_camera", "intrinsics"])
def test_gradient_of_the_camera_matches_the_reference(gradients, name):
    got, expected = gradients
    assert relative_error(getattr(got[1], name), getattr(expected[1], name)) < 1e-4


def test_gradient_of_the_background_matches_the_reference(gradients):
    assert relative_error(gradients[0][2], gradients[1][2]) < 1e-4


def test_opaque_clouds_lose_at_most_the_light_of_the_early_stop():
    gaussians, camera = small_scene()
    # So wide that no pixel comes near the alpha below which Gaussians do not count.
    gaussians = gaussians.replace(logit_opacities=jnp.full(20, 3.0), log_scales=jnp.full((20, 3), 1.5))
    expected = reference_image(gaussians, camera, BACKGROUND)
    np.testing.assert_allclose(render(gaussians, camera, background=BACKGROUND).image, expected.image, atol=1e-4)


@pytest.mark.parametrize("tile", [(16, 8)], ids=str)
def test_tile_size_does_not_matter(tile):
    gaussians, camera = small_scene()
    other = render(gaussians, camera, config=SplatConfig(tile_width=tile[0], tile_height=tile[1]))
    np.testing.assert_allclose(other.image, render(gaussians, camera).image, atol=1e-5)


def test_order_of_the_gaussians_does_not_matter():
    gaussians, camera = small_scene()
    order = np.random.default_rng(1).permutation(len(gaussians))
    shuffled = jax.tree.map(lambda x: x[order], gaussians)
    np.testing.assert_allclose(render(shuffled, camera).image, render(gaussians, camera).image, atol=1e-6)


def test_transparent_gaussian_changes_nothing():
    gaussians, camera = small_scene()
    extended = jax.tree.map(lambda x: jnp.concatenate([x, x[:1]]), gaussians)
    extended = extended.replace(logit_opacities=extended.logit_opacities.at[-1].set(-jnp.inf))
    np.testing.assert_array_equal(render(extended, camera).image, render(gaussians, camera).image)


def test_moving_cloud_and_camera_together_changes_nothing():
    gaussians, camera = small_scene()
    rotation = rotations.to_matrix(jnp.asarray([0.3, -0.5, 0.7, 0.2]))
    translation = jnp.asarray([0.4, -1.0, 2.0])
    moved = transform(gaussians, 1.0, rotation, translation)
    motion = jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(translation)
    with_it = camera.replace(world_to_camera=camera.world_to_camera @ jnp.linalg.inv(motion))
    np.testing.assert_allclose(render(moved, with_it).image, render(gaussians, camera).image, atol=1e-4)


def test_vmap_over_cameras_equals_a_loop():
    gaussians, _ = small_scene()
    cameras = orbit([0.0, 1.0, 2.5], target=(0, 0, 0), distance=3.0, width=16, height=12)
    batch = jax.vmap(lambda camera: render(gaussians, camera))(cameras)
    for k in range(3):
        one = render(gaussians, jax.tree.map(lambda x, k=k: x[k], cameras))
        np.testing.assert_allclose(batch.image[k], one.image, atol=1e-6)
        assert int(batch.info.total[k]) == int(one.info.total)


def test_gradient_under_vmap_over_clouds_is_each_cloud_s_gradient():
    _, camera = small_scene()
    clouds = [random_gaussians(n=20, seed=seed) for seed in range(2)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *clouds)
    got, _ = jax.vmap(energy_gradients, (0, None))(batch, camera)
    for k, cloud in enumerate(clouds):
        expected, _ = energy_gradients(cloud, camera)
        jax.tree.map(lambda g, e, k=k: np.testing.assert_allclose(g[k], e, atol=1e-5), got, expected)


def test_gradient_of_many_views_is_the_sum_of_their_gradients():
    gaussians, _ = small_scene()
    cameras = orbit([0.0, 2.0], target=(0, 0, 0), distance=3.0, width=16, height=12)

    def loss(cloud):
        return jnp.sum(jax.vmap(lambda camera: render(cloud, camera).image)(cameras) ** 2)

    views = [jax.tree.map(lambda x, k=k: x[k], cameras) for k in range(2)]
    expected = sum(energy_gradients(gaussians, view)[0].means for view in views)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(gaussians).means, expected, atol=1e-4)


def test_overflow_is_counted_and_drops_the_farthest():
    gaussians, camera = random_gaussians(n=20, size=0.3), front_camera(16, 12)
    whole = render(gaussians, camera)
    small = render(gaussians, camera, config=SplatConfig(capacity=50))
    assert int(small.info.total) == int(whole.info.total) > 50
    assert int(small.info.dropped) == int(whole.info.total) - 50
    assert int(whole.info.dropped) == 0


def test_required_capacity_is_enough_for_every_camera_of_a_batch():
    gaussians = random_gaussians(n=20, size=0.3)
    cameras = orbit([0.0, 1.0, 2.5], target=(0, 0, 0), distance=1.5, width=16, height=12)
    config = SplatConfig(capacity=required_capacity(gaussians, cameras))
    info = jax.vmap(lambda camera: render(gaussians, camera, config=config))(cameras).info
    assert int(jnp.max(info.dropped)) == 0
    assert config.capacity < 2 * int(jnp.max(info.total))


def test_more_intersections_than_any_capacity_are_refused():
    n = 1000
    gaussians = jax.tree.map(lambda x: jnp.repeat(x, n, axis=0), random_gaussians(n=1, size=10.0, spread=0.0))
    with pytest.raises(ValueError, match="intersections are more than"):
        required_capacity(gaussians, front_camera(1024, 1024))


@pytest.mark.parametrize("kind", ["none", "behind", "aside"])
def test_nothing_to_see_is_the_background(kind):
    gaussians = random_gaussians(n=0 if kind == "none" else 20, spread=0.1)
    offset = {"none": 0.0, "behind": 10.0, "aside": 0.0}[kind]
    gaussians = gaussians.replace(means=gaussians.means + jnp.asarray([[0.0, 0.0, offset]]))
    target = (100.0, 0.0, 3.0) if kind == "aside" else (0.0, 0.0, 0.0)
    camera = look_at((0.0, 0.0, 3.0), target, width=16, height=12)
    output = render(gaussians, camera, background=BACKGROUND)
    np.testing.assert_array_equal(output.image, np.broadcast_to(BACKGROUND, (12, 16, 3)))
    assert not np.any(output.alpha) and not np.any(output.depth) and int(output.info.total) == 0


@pytest.mark.parametrize("field", ["means", "log_scales", "quats", "logit_opacities", "colors"])
def test_gaussian_that_is_not_finite_is_left_out_and_counted(field):
    good, camera = small_scene()
    x = getattr(good, field)
    bad = good.replace(**{field: x.at[(3,) + (0,) * (x.ndim - 1)].set(jnp.nan)})
    rest = good.replace(logit_opacities=good.logit_opacities.at[3].set(-jnp.inf))
    output = render(bad, camera)
    assert int(output.info.non_finite) == 1
    np.testing.assert_allclose(output.image, render(rest, camera).image, atol=1e-6)


def test_overflowing_scale_is_left_out_and_counted():
    gaussians, camera = small_scene()
    output = render(gaussians.replace(log_scales=gaussians.log_scales.at[3].set(30.0)), camera)
    assert int(output.info.non_finite) == 1 and np.all(np.isfinite(output.image))


@pytest.mark.parametrize("field", ["means", "log_scales", "quats", "logit_opacities", "colors"])
def test_gaussian_that_is_not_finite_leaves_all_gradients_finite(field):
    gaussians, camera = small_scene()
    x = getattr(gaussians, field)
    gaussians = gaussians.replace(**{field: x.at[3].set(jnp.nan)})
    gradients = energy_gradients(gaussians, camera)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))


def test_zero_quaternion_has_finite_gradients():
    gaussians, camera = small_scene()
    gradients = energy_gradients(gaussians.replace(quats=jnp.zeros((20, 4))), camera)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))


def test_thin_huge_gaussian_matches_the_reference():
    gaussians = random_gaussians(n=1, spread=0.0).replace(log_scales=jnp.log(jnp.asarray([[300.0, 1e-3, 1e-3]])))
    camera = front_camera(24, 24)
    expected = reference_image(gaussians, camera)
    np.testing.assert_allclose(render(gaussians, camera).image, expected.image, atol=2e-3)


def test_scalar_background_is_grey():
    gaussians, camera = small_scene()
    grey = render(gaussians, camera, background=jnp.full(3, 0.5))
    np.testing.assert_array_equal(render(gaussians, camera, background=0.5).image, grey.image)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh": jnp.zeros((5, 4, 3))}, "3, 8 or 15 coefficients"),
        ({"quats": jnp.zeros((5, 3))}, r"gaussians\.quats must have shape \(5, 4\)"),
        ({"means": jnp.zeros((2, 5, 3))}, r"use jax\.vmap"),
        ({"colors": jnp.zeros((5, 3), jnp.bfloat16)}, "must be float32"),
    ],
)
def test_wrong_clouds_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        render(random_gaussians(n=5).replace(**change), front_camera(8, 8))


def test_wrong_cameras_and_backgrounds_are_refused():
    gaussians = random_gaussians(n=5)
    with pytest.raises(ValueError, match=r"camera\.intrinsics"):
        render(gaussians, Camera(jnp.eye(4), jnp.eye(4), 8, 8))
    with pytest.raises(ValueError, match="image size"):
        render(gaussians, Camera(jnp.eye(4), jnp.eye(3), 0, 8))
    with pytest.raises(ValueError, match="background"):
        render(gaussians, front_camera(8, 8), background=jnp.zeros(4))


@pytest.mark.parametrize("change", [{"capacity": 0}, {"near": 0.0}, {"eps2d": 0.0}, {"tile_width": 0}], ids=str)
def test_impossible_configurations_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        SplatConfig(**change)
