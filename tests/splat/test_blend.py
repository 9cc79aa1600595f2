"""The blending kernel with any number of channels, and with few lanes."""

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax.splat import SplatConfig
from avatarjax.splat.blend import blend, fields_of
from avatarjax.splat.project import project
from avatarjax.splat.reference import render_reference
from avatarjax.splat.tiles import TileGrid, bin_splats
from tests.splat.scenes import front_camera, random_gaussians


def blended_image(gaussians, camera, config):
    grid = TileGrid(camera.width, camera.height, config.tile_width, config.tile_height)
    splats = project(gaussians, camera, config)
    channels = [gaussians.colors[:, c] for c in range(gaussians.colors.shape[1])]
    blocks = blend(fields_of(splats, channels), bin_splats(splats, grid, 20_000), grid, config)
    return grid.assemble(blocks)


def test_image_and_gradient_match_the_reference_for_five_channels():
    channels = 5
    gaussians, camera = random_gaussians(n=30, channels=channels), front_camera(20, 16)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(16, 20, channels)), jnp.float32)

    def loss(draw):
        return jax.jit(jax.value_and_grad(lambda g: jnp.sum(weights * draw(g))))

    got, gradient = loss(lambda g: blended_image(g, camera, SplatConfig())[..., :channels])(gaussians)
    expected, oracle = loss(lambda g: render_reference(g, camera).image)(gaussians)
    np.testing.assert_allclose(got, expected, rtol=1e-4)
    jax.tree.map(lambda g, o: np.testing.assert_allclose(g, o, atol=1e-3, rtol=1e-3), gradient, oracle)


def test_number_of_lanes_and_steps_does_not_matter():
    gaussians, camera = random_gaussians(n=30), front_camera(20, 16)
    config = SplatConfig(forward_lanes=3, forward_steps=3)
    draw = jax.jit(blended_image, static_argnums=2)
    expected = draw(gaussians, camera, SplatConfig())
    np.testing.assert_allclose(draw(gaussians, camera, config), expected, atol=1e-6)
