"""One image on two devices is the image on one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import orbit, render
from avatarjax.splat import SplatConfig, required_capacity
from tests.splat.scenes import front_camera, random_gaussians


def scene(n=21):
    return random_gaussians(n=n, size=0.2), front_camera(18, 13)


def value_and_gradients(config):
    def loss(gaussians, camera):
        output = render(gaussians, camera, background=0.3, config=config)
        return jnp.sum(output.image**2) + jnp.sum(output.depth * output.alpha), output

    return jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))


@pytest.fixture(scope="module")
def both():
    """An odd number of Gaussians, and of tile rows, so that the parts are not equal."""
    return [value_and_gradients(SplatConfig(shards=shards))(*scene()) for shards in (1, 2)]


def test_picture_and_counts_are_the_same(both):
    (_, one), (_, two) = both[0][0], both[1][0]
    np.testing.assert_allclose(two.image, one.image, atol=1e-6)
    np.testing.assert_allclose(two.alpha, one.alpha, atol=1e-6)
    np.testing.assert_allclose(two.depth, one.depth, atol=1e-5)
    assert int(two.info.total) == int(one.info.total) > 0
    assert int(two.info.dropped) == int(two.info.non_finite) == 0


def test_gradients_are_the_same(both):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(b, a, atol=1e-4, rtol=1e-4), both[0][1], both[1][1])


def test_cameras_under_vmap_are_the_same():
    gaussians, _ = scene()
    cameras = orbit([0.0, 1.0], target=(0, 0, 0), distance=3.0, width=18, height=13)
    one, two = (
        jax.jit(jax.vmap(lambda c, s=shards: render(gaussians, c, config=SplatConfig(shards=s)).image))(cameras)
        for shards in (1, 2)
    )
    np.testing.assert_allclose(two, one, atol=1e-6)


def test_overflow_of_a_part_is_counted():
    gaussians, camera = scene()
    info = render(gaussians, camera, config=SplatConfig(shards=2, capacity=40)).info
    assert int(info.dropped) >= int(info.total) - 40 > 0


def test_required_capacity_is_enough_for_the_fuller_part():
    gaussians, camera = scene()
    config = SplatConfig(shards=2, capacity=required_capacity(gaussians, camera, SplatConfig(shards=2)))
    assert int(render(gaussians, camera, config=config).info.dropped) == 0


def test_more_shards_than_devices_are_refused():
    gaussians, camera = scene()
    with pytest.raises(ValueError, match="needs 64 devices, found 2"):
        render(gaussians, camera, config=SplatConfig(shards=64))
