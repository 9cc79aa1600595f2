"""The blending kernel with few lanes, several scenes at once, and any number of steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.splat import SplatConfig
from avatarjax.splat.blend import _exclusive, _exp2, blend
from avatarjax.splat.project import project
from avatarjax.splat.tiles import TileGrid, bin_splats
from tests.splat.scenes import front_camera, random_gaussians


def blended_image(gaussians, camera, config):
    grid = TileGrid(camera.width, camera.height, config.tile_width, config.tile_height)
    table, _ = project(gaussians, gaussians.colors, camera, config)
    return grid.assemble(blend(table, bin_splats(table, grid, 20_000), grid.corners(), config))


@pytest.mark.parametrize(
    "config",
    [
        SplatConfig(forward_lanes=3, forward_steps=3, backward_lanes=5, backward_steps=3),
        SplatConfig(forward_steps=1, backward_steps=1),
        # As on other platforms than CPU, where all tiles are in flight.
        SplatConfig(forward_lanes=4096, backward_lanes=4096, backward_steps=16),
    ],
    ids=["few", "one", "many"],
)
def test_number_of_lanes_and_steps_does_not_matter(config):
    gaussians, camera = random_gaussians(n=30), front_camera(20, 16)

    def draw(config):
        def loss(gaussians):
            image = blended_image(gaussians, camera, config)
            return jnp.sum(image**2), image

        return jax.jit(jax.grad(loss, has_aux=True))(gaussians)

    (gradient, image), (expected_gradient, expected) = draw(config), draw(SplatConfig())
    np.testing.assert_allclose(image, expected, atol=1e-6)
    jax.tree.map(lambda g, e: np.testing.assert_allclose(g, e, atol=1e-4, rtol=1e-3), gradient, expected_gradient)


@pytest.mark.parametrize("steps", [1, 3, 4, 8, 12])
def test_exclusive_products_and_sums_are_those_of_numpy(steps):
    x = np.random.default_rng(steps).uniform(0.1, 1.0, size=(2, steps, 5)).astype(np.float32)
    before, total = _exclusive(jnp.multiply, jnp.asarray(x), 1.0)
    products = np.cumprod(x, axis=1)
    np.testing.assert_allclose(total, products[:, -1], rtol=1e-5)
    np.testing.assert_allclose(before, products / x, rtol=1e-5)
    before, total = _exclusive(jnp.add, jnp.asarray(x), 0.0)
    sums = np.cumsum(x, axis=1)
    np.testing.assert_allclose(total, sums[:, -1], rtol=1e-5)
    np.testing.assert_allclose(before, sums - x, atol=1e-5)


def test_power_of_two_is_exact_to_float32():
    x = np.linspace(-9, 1, 100_001).astype(np.float32)
    got = np.asarray(jax.jit(_exp2)(jnp.asarray(x)[:, None, None]), np.float64)[:, 0, 0]
    np.testing.assert_allclose(got, np.exp2(x.astype(np.float64)), rtol=3e-7)


def test_power_of_two_of_very_small_numbers_is_invisible():
    assert float(_exp2(jnp.full((1, 1, 1), -1e9))[0, 0, 0]) < 1 / 255
