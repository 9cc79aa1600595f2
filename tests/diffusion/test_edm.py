import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.diffusion import edm


def silent(x, log_sigma):
    """The optimal network for unit Gaussian data: all of the optimal denoiser is in the skip connection."""
    return jnp.zeros_like(x)


def knows(point):
    """The optimal network where all data are one point."""

    def network(x, quarter_log_sigma):
        sigma = jnp.exp(4 * quarter_log_sigma)[:, None]
        noisy = x * jnp.sqrt(sigma**2 + 1)
        return (point[None] - noisy / (sigma**2 + 1)) * jnp.sqrt(sigma**2 + 1) / sigma

    return network


def test_denoising_unit_gaussian_data_is_the_posterior_mean(key):
    x = jax.random.normal(key, (4, 3))
    sigma = jnp.array([0.01, 0.5, 1.0, 30.0])
    expected = np.asarray(x) / (1 + np.asarray(sigma)[:, None] ** 2)
    np.testing.assert_allclose(edm.denoise(silent, x, sigma), expected, rtol=1e-5)


def test_the_network_sees_inputs_of_unit_variance_and_a_quarter_of_the_log_level():
    seen = {}

    def network(x, log_sigma):
        seen.update(x=x, log_sigma=log_sigma)
        return x

    edm.denoise(network, jnp.full((1, 2), 5.0), jnp.array([2.0]))
    np.testing.assert_allclose(seen["x"], 5 / np.sqrt(5), rtol=1e-6)
    np.testing.assert_allclose(seen["log_sigma"], np.log(2) / 4, rtol=1e-6)


def test_every_noise_levels_initial_loss_is_one():
    """E (D - y)^2 = sigma^2 / (sigma^2 + 1) for unit Gaussian data and a silent network."""
    sigma = jnp.array([0.03, 0.4, 1.0, 5.0])
    np.testing.assert_allclose(edm.loss_weight(sigma) * sigma**2 / (sigma**2 + 1), 1, rtol=1e-5)


def test_training_levels_stay_in_bounds_with_the_asked_share_at_the_top(key):
    sigma = np.asarray(edm.sample_sigma(key, 4000, 0.03, 5.0, 0.4))
    assert sigma.min() >= 0.03 * (1 - 1e-5) and sigma.max() == 5.0
    assert np.mean(sigma == 5.0) == pytest.approx(0.4, abs=0.03)
    below = np.log(sigma[sigma < 5.0] / 0.03) / np.log(5.0 / 0.03)
    np.testing.assert_allclose(np.quantile(below, [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.04)


@pytest.mark.parametrize("steps", [1, 2, 5, 18])
def test_sampling_levels_descend_from_the_top_to_zero(steps):
    sigmas = np.asarray(edm.sigma_steps(steps, 0.03, 5.0))
    assert sigmas.shape == (steps + 1,)
    np.testing.assert_allclose(sigmas[0], 5.0, rtol=1e-5)
    assert sigmas[-1] == 0 and (np.diff(sigmas) < 0).all()


def test_few_steps_raise_the_last_level_and_many_reach_the_lowest():
    assert float(edm.sigma_steps(2, 0.03, 5.0)[-2]) == pytest.approx(0.75, rel=1e-4)
    assert float(edm.sigma_steps(18, 0.03, 5.0)[-2]) == pytest.approx(0.03, rel=1e-4)


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="at least one step, got 0"):
        edm.sigma_steps(0, 0.03, 5.0)


@pytest.mark.parametrize("steps", [1, 4])
def test_euler_finds_a_point_mass(key, steps):
    point = jnp.array([0.3, -2.0, 1.0])
    found = edm.euler(knows(point), jax.random.normal(key, (5, 3)), edm.sigma_steps(steps, 0.03, 5.0))
    np.testing.assert_allclose(found, np.tile(point, (5, 1)), atol=1e-4)


def test_euler_follows_the_probability_flow_of_a_gaussian(key):
    """For unit Gaussian data the flow keeps x / sqrt(1 + sigma^2)."""
    noise = jax.random.normal(key, (5, 3))
    found = edm.euler(silent, noise, edm.sigma_steps(400, 0.01, 5.0))
    np.testing.assert_allclose(found, noise * 5 / np.sqrt(26), atol=0.02)
