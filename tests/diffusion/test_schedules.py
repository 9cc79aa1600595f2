import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.diffusion import schedules

NAMES = ("linear", "scaled_linear", "cosine")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("steps", [20, 1000])
def test_the_signal_falls_from_almost_one_towards_zero(name, steps):
    signal = np.asarray(schedules.alphas_cumprod(name, steps))
    assert signal.shape == (steps,)
    assert 0.9 < signal[0] <= 1
    assert (np.diff(signal) < 0).all() and (signal > 0).all()
    assert signal[-1] < 0.01


def test_the_linear_schedule_of_1000_steps_is_ddpms():
    expected = np.cumprod(1 - np.linspace(1e-4, 0.02, 1000))
    np.testing.assert_allclose(schedules.alphas_cumprod("linear", 1000), expected, rtol=1e-5)


def test_the_scaled_linear_schedule_ends_where_stable_diffusions_does():
    np.testing.assert_allclose(schedules.alphas_cumprod("scaled_linear", 1000)[-1], 0.0047, atol=5e-5)


def test_the_cosine_schedule_is_the_squared_cosine():
    t = (np.arange(1, 1000) / 1000 + 0.008) / 1.008 * np.pi / 2
    expected = np.cos(t) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2
    np.testing.assert_allclose(schedules.alphas_cumprod("cosine", 1000)[:-1], expected, atol=1e-5)


def test_an_unknown_name_is_refused_with_the_known_ones():
    # The type checker of the tests would refuse the name first.
    unchecked = schedules.alphas_cumprod
    while hasattr(unchecked, "__wrapped__"):
        unchecked = unchecked.__wrapped__
    with pytest.raises(ValueError, match=r"'sigmoid'.*linear.*scaled_linear.*cosine"):
        unchecked("sigmoid", 10)


def test_noise_is_mixed_at_each_samples_own_timestep(key):
    signal = jnp.array([1.0, 0.64, 0.36])
    clean, noise = jax.random.normal(key, (2, 2, 3, 4, 5))
    noisy = schedules.add_noise(signal, clean, noise, jnp.array([0, 2]))
    np.testing.assert_allclose(noisy[0], clean[0], atol=1e-6)
    np.testing.assert_allclose(noisy[1], 0.6 * clean[1] + 0.8 * noise[1], atol=1e-6)


@pytest.mark.parametrize("train_steps", [1, 7, 100, 1000])
def test_timesteps_descend_from_the_last_for_every_number_of_steps(train_steps):
    for steps in [*range(1, min(train_steps, 60) + 1), train_steps]:
        t = np.asarray(schedules.ddim_timesteps(train_steps, steps))
        assert len(t) == steps
        assert t[0] == train_steps - 1 and t[-1] >= 0 and (np.diff(t) < 0).all()


@pytest.mark.parametrize("steps", [0, -1, 1001])
def test_impossible_numbers_of_steps_are_refused(steps):
    with pytest.raises(ValueError, match=rf"1\.\.1000, got {steps}"):
        schedules.ddim_timesteps(1000, steps)
