"""The renderer against its float64 reference, and what must hold for any scene."""

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import strategies
from jax.experimental import checkify

from avatarjax import Camera, look_at, orbit, render, rotations
from avatarjax.gaussians import transform
from avatarjax.splat import SplatConfig, check, required_capacity
from avatarjax.splat.reference import render_reference
from benchmarks.scenes import body_camera, body_cloud
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
    return np.linalg.norm(got - expected) / max(np.linalg.norm(expected), 1e-12)


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


def batched(shape):
    """Clouds of one camera each in a batch of this shape, and `render` under as many `vmap`s."""
    count = int(np.prod(shape))
    clouds = [random_gaussians(n=20, seed=seed) for seed in range(count)]
    cameras = orbit(np.linspace(0, 2, count), target=(0, 0, 0), distance=3.0, width=16, height=12)
    clouds = jax.tree.map(lambda *x: jnp.stack(x).reshape(*shape, *x[0].shape), *clouds)
    return clouds, jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), cameras)


@pytest.mark.parametrize("channels", [3, 32])
@pytest.mark.parametrize("shape", [(), (2,), (2, 3)], ids=str)
def test_features_and_their_gradients_match_the_reference_in_any_batch(shape, channels):
    rng = np.random.default_rng(0)
    clouds, cameras = batched(shape)
    features = jnp.asarray(rng.normal(size=(*shape, 20, channels)), jnp.float32)
    background = jnp.asarray(rng.normal(size=channels), jnp.float32)
    weights = jnp.asarray(rng.normal(size=(*shape, 12, 16, channels)), jnp.float32)

    def energy(draw):
        def loss(clouds, features, cameras, background, weights):
            one = lambda g, c, f: draw(g, c, features=f, background=background).image  # noqa: E731
            for _ in shape:
                one = jax.vmap(one)
            image = one(clouds, cameras, features)
            return jnp.sum(weights * image), image

        return jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True))

    inputs = (clouds, features, cameras, background, weights)
    (_, image), gradients = energy(render)(*inputs)
    with jax.enable_x64(True):
        (_, expected), oracle = jax.tree.map(np.asarray, energy(render_reference)(*to_float64(inputs)))
    np.testing.assert_allclose(image, expected, atol=1e-5)
    for got, want in zip(jax.tree.leaves(gradients), jax.tree.leaves(oracle), strict=True):
        assert relative_error(got, want) < 1e-4


@pytest.mark.parametrize(
    "config", [SplatConfig(antialiased=True), SplatConfig(cull_ellipses=True)], ids=["mip", "cull"]
)
def test_options_match_the_reference_with_gradients(config):
    gaussians, camera = random_gaussians(size=0.02), front_camera(37, 23)

    def energy(draw):
        loss = lambda g, c: jnp.sum(draw(g, c, config=config).image ** 2)  # noqa: E731
        return jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))

    got, gradients = energy(render)(gaussians, camera)
    with jax.enable_x64(True):
        expected, oracle = jax.tree.map(np.asarray, energy(render_reference)(*to_float64((gaussians, camera))))
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    for x, y in zip(jax.tree.leaves(gradients), jax.tree.leaves(oracle), strict=True):
        assert relative_error(x, y) < 1e-4


def test_antialiasing_keeps_the_light_of_a_small_gaussian():
    gaussian = random_gaussians(n=1, size=0.01, spread=0.0).replace(logit_opacities=jnp.asarray([3.0]))
    near, far = (front_camera(32, 32, eye=(0.0, 0.0, distance)) for distance in (1.0, 2.0))

    def light(camera, antialiased):
        return float(jnp.sum(render(gaussian, camera, config=SplatConfig(antialiased=antialiased)).alpha))

    # Twice as far away, a quarter of the area; without the correction the blur keeps it as large as before.
    assert 3.5 < light(near, True) / light(far, True) < 4.5
    assert light(near, False) / light(far, False) < 2


def body_scene():
    """A small body-like cloud with random opacities: where all are opaque, the early stop shows (below)."""
    cloud, camera = body_cloud(1500), body_camera(40)
    logits = np.random.default_rng(1).normal(size=1500).astype(np.float32)
    return cloud.replace(logit_opacities=jnp.asarray(logits)), camera


def test_body_like_scene_matches_the_reference_with_gradients():
    gaussians, camera = body_scene()
    inputs = (gaussians, camera, jnp.asarray(BACKGROUND))
    output = render(gaussians, camera, background=BACKGROUND)
    expected = reference_image(gaussians, camera, BACKGROUND)
    np.testing.assert_allclose(output.image, expected.image, atol=1e-5)
    got = jax.jit(jax.grad(weighted_sum(render), argnums=(0, 1, 2)))(*inputs)
    with jax.enable_x64(True):
        oracle = jax.jit(jax.grad(weighted_sum(render_reference), argnums=(0, 1, 2)))(*to_float64(inputs))
        oracle = jax.tree.map(np.asarray, oracle)
    jax.tree.map(lambda g, o: np.testing.assert_array_less(relative_error(g, o), 1e-4), got, oracle)


def test_gradient_descent_recovers_a_perturbed_scene():
    truth, _ = small_scene()
    cameras = orbit([0.0, 1.5, 3.0], target=(0, 0, 0), distance=3.0, width=16, height=12)
    draw = jax.vmap(lambda cloud, camera: render(cloud, camera).image, (None, 0))
    target = draw(truth, cameras)
    rng = np.random.default_rng(3)
    start = jax.tree.map(lambda x: x + jnp.asarray(0.05 * rng.normal(size=x.shape), jnp.float32), truth)
    optimiser = optax.adam(5e-3)
    loss = lambda cloud: jnp.mean((draw(cloud, cameras) - target) ** 2)  # noqa: E731

    @jax.jit
    def step(_, carry):
        cloud, state = carry
        updates, state = optimiser.update(jax.grad(loss)(cloud), state)
        return optax.apply_updates(cloud, updates), state

    fitted, _ = jax.lax.fori_loop(0, 150, step, (start, optimiser.init(start)))
    assert float(loss(fitted)) < 0.02 * float(loss(start))


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


def test_gaussians_at_one_depth_are_blended_in_their_order():
    gaussians = random_gaussians(n=2, spread=0.0, size=0.3).replace(
        logit_opacities=jnp.full(2, 8.0), colors=jnp.asarray([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    )
    pixel = render(gaussians, front_camera(15, 15)).image[7, 7]
    assert pixel[0] > 0.9 > 0.1 > pixel[1]


def test_one_gaussian_over_the_whole_image_reaches_every_pixel():
    gaussian = random_gaussians(n=1, size=50.0, spread=0.0).replace(logit_opacities=jnp.asarray([2.0]))
    output = render(gaussian, front_camera(19, 13))
    np.testing.assert_allclose(output.alpha, jax.nn.sigmoid(2.0), atol=1e-3)
    assert int(output.info.total) == 3 * 4


@hypothesis.settings(max_examples=25, deadline=None, derandomize=True)
@hypothesis.given(
    seed=strategies.integers(0, 10_000), size=strategies.floats(1e-4, 30.0), spread=strategies.floats(0, 9)
)
def test_alpha_is_between_zero_and_one_and_nothing_is_infinite(seed, size, spread):
    _, camera = small_scene()
    output = render(random_gaussians(n=20, seed=seed, size=size, spread=spread), camera)
    assert np.all(output.alpha >= 0) and np.all(output.alpha <= 1)
    assert np.all(np.isfinite(output.image)) and np.all(np.isfinite(output.depth))


@pytest.mark.parametrize("fits", [True, False])
def test_check_raises_what_does_not_fit_under_checkify(fits):
    gaussians, camera = random_gaussians(n=20, size=0.3), front_camera(16, 12)
    config = SplatConfig(capacity=required_capacity(gaussians, camera) if fits else 50)

    def draw(gaussians):
        output = render(gaussians, camera, config=config)
        check(output.info)
        return output.image

    error, _ = jax.jit(checkify.checkify(draw))(gaussians)
    assert (error.get() is None) if fits else ("did not fit" in error.get())


def test_check_raises_gaussians_that_are_not_finite():
    gaussians, camera = small_scene()
    info = render(gaussians.replace(means=gaussians.means.at[3].set(jnp.nan)), camera).info
    with pytest.raises(checkify.JaxRuntimeError, match="1 Gaussians are not finite"):
        check(info)


@pytest.mark.parametrize("derivative", ["forward", "second"])
def test_derivatives_that_do_not_exist_are_refused(derivative):
    gaussians, camera = small_scene()
    loss = lambda g: jnp.sum(render(g, camera).image ** 2)  # noqa: E731
    if derivative == "forward":
        with pytest.raises(TypeError, match="forward-mode"):
            jax.jvp(loss, (gaussians,), (gaussians,))
    else:
        with pytest.raises(TypeError, match="first derivatives only"):
            jax.grad(lambda g: jnp.sum(jax.grad(loss)(g).means))(gaussians)


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


@pytest.mark.parametrize(
    ("field", "value"), [("log_scales", 30.0), ("log_scales", 60.0), ("means", 1e38), ("means", (1e38, 0.0, 0.0))]
)
def test_gaussian_that_overflows_leaves_all_gradients_finite(field, value):
    gaussians, camera = random_gaussians(n=20), front_camera(16, 12, eye=(0.0, 0.0, 3.0))
    x = getattr(gaussians, field)
    # The first is what is read past the end of the last list.
    gradients = energy_gradients(gaussians.replace(**{field: x.at[0].set(jnp.asarray(value))}), camera)
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


@pytest.mark.parametrize("n", [0, 20])
def test_picture_without_depth_is_the_same_with_the_same_gradients(n):
    camera = front_camera(16, 12)
    gaussians = random_gaussians(n=n)

    def energy(depth):
        loss = lambda g: jnp.sum(render(g, camera, background=0.2, config=SplatConfig(depth=depth)).image ** 2)  # noqa: E731
        return jax.jit(jax.value_and_grad(loss))(gaussians)

    assert render(gaussians, camera, config=SplatConfig(depth=False)).depth is None
    (got, gradient), (expected, with_depth) = energy(False), energy(True)
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), gradient, with_depth)


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
        ({"sh": jnp.zeros((4, 3, 3))}, r"gaussians\.sh must have shape \(5, 3, 3\)"),
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
    with pytest.raises(ValueError, match="features"):
        render(gaussians, front_camera(8, 8), features=jnp.zeros((4, 7)))


@pytest.mark.parametrize("change", [{"capacity": 0}, {"near": 0.0}, {"eps2d": 0.0}, {"tile_width": 0}], ids=str)
def test_impossible_configurations_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        SplatConfig(**change)
