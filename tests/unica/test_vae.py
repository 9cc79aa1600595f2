import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import functional
from avatarjax.nets.functional import bind
from avatarjax.unica import vae
from avatarjax.unica.vae import VAE, VAEConfig
from tests.parameters import random_params

CONFIG = VAEConfig(channels=(8, 8, 16), residual_blocks=1)


@pytest.fixture(scope="module")
def params():
    return random_params(VAE, CONFIG, scale=0.1)


def test_latents_are_smaller_by_the_downsampling_and_come_back(params):
    x = jax.ShapeDtypeStruct((2, 16, 24, 3), jnp.float32)
    mean, log_variance = jax.eval_shape(lambda p, x: bind(VAE, CONFIG, p).encode(x), params, x)
    assert CONFIG.downsampling == 4
    assert mean.shape == log_variance.shape == (2, 4, 6, 4)
    assert jax.eval_shape(lambda p, z: bind(VAE, CONFIG, p).decode(z), params, mean).shape == x.shape


def test_maps_of_a_batch_do_not_mix(params, key):
    encode = jax.jit(lambda x: bind(VAE, CONFIG, params).encode(x)[0])
    x = jax.random.normal(key, (2, 8, 8, 3))
    changed = x.at[1].set(0.0)
    np.testing.assert_allclose(encode(changed)[0], encode(x)[0], atol=1e-5)
    assert np.abs(encode(changed)[1] - encode(x)[1]).max() > 1e-3


def test_learned_places_change_nothing_until_they_are_learned(params, key):
    config = dataclasses.replace(CONFIG, positions=8)
    neutral = {
        name: {"gain": jnp.ones((side, side, c)), "shift": jnp.zeros((side, side, c))}
        for name, side, c in (
            ("encoder_fine", 8, 8),
            ("encoder_coarse", 2, 16),
            ("decoder_coarse", 2, 16),
            ("decoder_fine", 8, 8),
        )
    }
    x = jax.random.normal(key, (1, 8, 8, 3))

    @functools.partial(jax.jit, static_argnums=0)
    def around(config, params):
        network = bind(VAE, config, params)
        return network.decode(network.encode(x)[0])

    np.testing.assert_allclose(around(config, {**params, "places": neutral}), around(CONFIG, params), atol=1e-5)
    shift = jnp.zeros((8, 8, 8)).at[0, 0].set(1.0)
    moved = {**neutral, "decoder_fine": {**neutral["decoder_fine"], "shift": shift}}
    assert np.abs(around(config, {**params, "places": moved}) - around(CONFIG, params)).max() > 1e-3


def test_the_papers_autoencoder_downsamples_by_eight():
    assert VAEConfig().downsampling == 8


def test_samples_have_the_mean_and_variance_asked_for(key):
    mean, log_variance = jnp.full((40_000,), 2.0), jnp.full((40_000,), np.log(0.25))
    drawn = vae.sample_latent(mean, log_variance, key)
    assert float(drawn.mean()) == pytest.approx(2, abs=0.02)
    assert float(drawn.std()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("mean, variance", [(0.0, 1.0), (1.5, 0.3), (-2.0, 4.0)])
def test_divergence_is_the_integral_it_stands_for(mean, variance):
    x = np.linspace(mean - 12 * np.sqrt(variance), mean + 12 * np.sqrt(variance), 200_001)
    log_q = -0.5 * ((x - mean) ** 2 / variance + np.log(2 * np.pi * variance))
    log_p = -0.5 * (x**2 + np.log(2 * np.pi))
    integral = np.trapezoid(np.exp(log_q) * (log_q - log_p), x)
    full = functools.partial(jnp.full, (1, 3))
    assert float(vae.kl_divergence(full(mean), full(np.log(variance)))) == pytest.approx(integral, abs=1e-4)


def test_the_decoder_may_have_more_blocks_than_the_encoder(key):
    """With three a stage it is Stable Diffusion 1.5's autoencoder, of 84 million parameters."""
    config = dataclasses.replace(CONFIG, decoder_blocks=3)
    shapes = functional.shapes(VAE, config)
    assert len(shapes["down"]) == 3 and len(shapes["up"]) == 9
    z = jax.ShapeDtypeStruct((2, 2, 2, 4), jnp.float32)
    assert jax.eval_shape(lambda p, z: bind(VAE, config, p).decode(z), shapes, z).shape == (2, 8, 8, 3)
    assert functional.count(functional.shapes(VAE, VAEConfig(decoder_blocks=3))) == pytest.approx(83.65e6, rel=0.01)
