"""The appearance loss: its parts, and the LPIPS term where there is a network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import look_at
from avatarjax.gaussians import Gaussians
from avatarjax.metrics import image, lpips
from avatarjax.splat import SplatConfig, render
from avatarjax.unica import photometric

SIZE = 32
SPLAT = SplatConfig(capacity=4096, depth=False)


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    n = 60
    return Gaussians(
        means=jnp.asarray(rng.uniform(-0.5, 0.5, (n, 3)), jnp.float32),
        log_scales=jnp.full((n, 3), -2.5),
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32),
        logit_opacities=jnp.full((n,), 1.0),
        colors=jnp.asarray(rng.random((n, 3)), jnp.float32),
    )


@pytest.fixture(scope="module")
def views():
    eyes = [(0, 0, 2.0), (2.0, 0.3, 0)]
    cameras = [look_at(eye, (0, 0, 0), width=SIZE, height=SIZE) for eye in eyes]
    return jax.tree.map(lambda *x: jnp.stack(x), *cameras)


@pytest.fixture(scope="module")
def rgba():
    return np.random.default_rng(1).integers(0, 256, (2, SIZE, SIZE, 4)).astype(np.uint8)


def untrained_network():
    """A backbone of the right form: what it sees is no matter here."""
    rng = np.random.default_rng(2)
    shapes = [(11, 11, 3, 4), (5, 5, 4, 4), (3, 3, 4, 4), (3, 3, 4, 4), (3, 3, 4, 4)]
    return lpips.Network(
        kernels=tuple(jnp.asarray(rng.normal(size=s), jnp.float32) for s in shapes),
        biases=(jnp.zeros(4),) * 5,
        heads=(jnp.ones(4),) * 5,
        name="alex",
    )


@pytest.fixture(scope="module")
def network():
    return untrained_network()


@pytest.mark.parametrize("white", [0.0, 1.0])
def test_it_is_the_weighted_sum_of_its_metrics(config, cloud, views, rgba, network, white):
    value, metrics = jax.jit(lambda c: photometric.loss(config, c, views, rgba, jnp.asarray(white), SPLAT, network))(
        cloud
    )
    cameras = [jax.tree.map(lambda x, k=k: x[k], views) for k in range(2)]
    drawn = jnp.stack([render(cloud, c, background=jnp.asarray(white), config=SPLAT).image for c in cameras])
    drawn, truth = jnp.clip(drawn, 0, 1), photometric.over(rgba, white)
    perceived = jnp.mean(lpips.distance(network, drawn, truth))
    expected = config.loss_l1 * jnp.mean(jnp.abs(drawn - truth)) + config.loss_lpips * perceived
    expected += config.loss_ssim * (1 - jnp.mean(image.ssim(drawn, truth)))
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    np.testing.assert_allclose(metrics["lpips"], perceived, rtol=1e-4)
    np.testing.assert_allclose(metrics["psnr"], jnp.mean(image.psnr(drawn, truth)), rtol=1e-4)
    assert float(metrics["dropped"]) == 0


def test_without_a_network_there_is_no_such_term(config, cloud, views, rgba, network):
    def value(config, network):
        return photometric.loss(config, cloud, views, rgba, jnp.zeros(()), SPLAT, network)

    without, metrics = value(config, None)
    assert "lpips" not in metrics
    np.testing.assert_allclose(without, value(dataclasses.replace(config, loss_lpips=0.0), network)[0], rtol=1e-5)


def test_its_gradient_reaches_the_gaussians_through_the_network(config, cloud, views, rgba, network):
    only = dataclasses.replace(config, loss_l1=0.0, loss_ssim=0.0)
    slope = jax.grad(lambda c: photometric.loss(only, c, views, rgba, jnp.zeros(()), SPLAT, network)[0])(cloud)
    for leaf in (slope.means, slope.colors, slope.log_scales):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0


def test_checkpoints_know_with_which_network_they_were_trained(config, network):
    other = network.replace(name="vgg")
    found = {photometric.settings(config, n) for n in (None, network, other)}
    assert len(found) == 3


def test_pictures_lie_over_any_grey():
    rgba = np.zeros((1, 2, 4), np.uint8)
    rgba[0, 0] = 200, 100, 0, 255
    np.testing.assert_allclose(photometric.over(rgba, 0.5)[0], [[200 / 255, 100 / 255, 0], [0.5] * 3], atol=1e-6)
