"""The renderer against its float64 reference, and what must hold for any scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import render
from avatarjax.splat.reference import render_reference
from tests.splat.scenes import front_camera, random_gaussians

BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)


def to_float64(tree):
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), tree)


def reference_image(gaussians, camera, background=0.0):
    with jax.enable_x64(True):
        output = render_reference(to_float64(gaussians), to_float64(camera), background=np.float64(background))
        return jax.tree.map(np.asarray, output)


def relative_error(got, expected):
    got, expected = np.asarray(got, np.float64), np.asarray(expected, np.float64)
    return np.linalg.norm(got - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("size", [(40, 28), (16, 16), (37, 23), (1, 1), (5, 61)], ids=str)
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
    rng = np.random.default_rng(5)

    def loss(gaussians, camera, background):
        output = draw(gaussians, camera, background=background)
        weights = (rng.normal(size=np.shape(x)) for x in (output.image, output.alpha, output.depth))
        rng.bit_generator.state = np.random.default_rng(5).bit_generator.state
        wi, wa, wd = (jnp.asarray(w, output.image.dtype) for w in weights)
        return jnp.sum(wi * output.image) + jnp.sum(wa * output.alpha) + 0.1 * jnp.sum(wd * output.depth * output.alpha)

    return loss


@pytest.fixture(scope="module")
def gradients():
    gaussians, camera = random_gaussians(), front_camera()
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
