import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.diffusion import samplers, schedules

SIGNAL = schedules.alphas_cumprod("scaled_linear", 1000)


@pytest.mark.parametrize("steps", [1, 3, 10])
def test_ddim_with_the_exact_noise_of_a_point_finds_the_point(key, steps):
    a, b = jax.random.split(key)
    point = jax.random.normal(a, (3, 4))

    def predict(x, t):
        return (x - jnp.sqrt(SIGNAL[t]) * point) / jnp.sqrt(1 - SIGNAL[t])

    found = samplers.ddim(predict, jax.random.normal(b, (3, 4)), SIGNAL, schedules.ddim_timesteps(1000, steps))
    np.testing.assert_allclose(found, point, atol=1e-4)


def test_ddim_with_the_exact_noise_of_a_gaussian_maps_quantiles_to_quantiles():
    """The probability flow keeps (x - sqrt(a) mean) / sqrt(a variance + 1 - a): from unit noise to the data."""
    mean, spread = 3.0, 0.5

    def predict(x, t):
        a = SIGNAL[t]
        return jnp.sqrt(1 - a) * (x - jnp.sqrt(a) * mean) / (a * spread**2 + 1 - a)

    start = jnp.linspace(-2, 2, 9)
    found = samplers.ddim(predict, start, SIGNAL, schedules.ddim_timesteps(1000, 500))
    a = float(SIGNAL[-1])
    quantile = (start - np.sqrt(a) * mean) / np.sqrt(a * spread**2 + 1 - a)
    np.testing.assert_allclose(found, mean + spread * quantile, atol=0.01)


def test_one_ddim_step_is_equation_12():
    signal = jnp.array([0.81, 0.25])
    found = samplers.ddim(lambda x, t: 0.1 * x + t, jnp.array([2.0]), signal, jnp.array([1, 0]))
    noise = 0.1 * 2.0 + 1
    clean = (2.0 - np.sqrt(0.75) * noise) / 0.5
    x = 0.9 * clean + np.sqrt(0.19) * noise
    np.testing.assert_allclose(found, [(x - np.sqrt(0.19) * 0.1 * x) / 0.9], rtol=1e-5)


class TestGuidance:
    def counted(self, value, calls):
        def predict(x, t):
            calls.append(value)
            return jnp.full_like(x, value)

        return predict

    def test_scale_one_asks_only_the_conditional_network(self):
        calls = []
        predict = samplers.guided(self.counted(2.0, calls), self.counted(1.0, calls), 1.0)
        np.testing.assert_array_equal(predict(jnp.zeros(3), jnp.asarray(0)), [2.0] * 3)
        assert calls == [2.0]

    @pytest.mark.parametrize("scale", [0.0, 2.5])
    def test_other_scales_extrapolate_from_the_unconditional_one(self, scale):
        predict = samplers.guided(self.counted(2.0, []), self.counted(0.5, []), scale)
        np.testing.assert_allclose(predict(jnp.zeros(3), jnp.asarray(0)), [0.5 + scale * 1.5] * 3)
