"""Springs against closed forms and against a fine integration in float64."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.physics import springs


def test_two_half_steps_are_one_step():
    x, v = jnp.array([1.0, -0.3]), jnp.array([0.5, 2.0])
    once = springs.critical_step(x, v, 0.2, 9.0, 0.1)
    twice = springs.critical_step(*springs.critical_step(x, v, 0.2, 9.0, 0.05), 0.2, 9.0, 0.05)
    np.testing.assert_allclose(once, twice, atol=1e-6)


def test_critical_step_is_the_closed_form():
    w, t = 7.0, 0.31
    x, _ = springs.critical_step(jnp.array(1.0), jnp.array(0.0), 0.0, w, t)
    assert float(x) == pytest.approx((1 + w * t) * np.exp(-w * t), abs=1e-6)


def test_follow_matches_a_fine_float64_integration():
    dt, w, z = 1 / 30, 17.0, 0.35
    targets = np.random.default_rng(0).normal(size=(12, 2)).cumsum(0)
    x, v, want = targets[0].copy(), np.zeros(2), [targets[0]]
    fine = 4000
    for a, b in itertools.pairwise(targets):
        for k in range(fine):
            goal = a + (b - a) * (k + 0.5) / fine
            v = v + (w * w * (goal - x) - 2 * z * w * v) * dt / fine
            x = x + v * dt / fine
        want.append(x.copy())
    got = springs.follow(jnp.asarray(targets, jnp.float32), frequency=w, damping=z, dt=dt)
    np.testing.assert_allclose(got, np.array(want), atol=2e-3)


def test_follow_rests_on_a_target_that_stays():
    targets = jnp.full((20, 3, 2), 4.0)
    np.testing.assert_array_equal(springs.follow(targets, frequency=17.0, damping=0.35, dt=1 / 30), targets)


def test_follow_under_vmap_is_follow_of_each():
    targets = jax.random.normal(jax.random.key(1), (3, 10, 4))
    follow = lambda t: springs.follow(t, frequency=12.0, damping=0.5, dt=1 / 30)  # noqa: E731
    np.testing.assert_allclose(jax.vmap(follow)(targets), jnp.stack([follow(t) for t in targets]), atol=1e-5)


def test_follow_refuses_an_over_damped_spring():
    with pytest.raises(ValueError, match="damping"):
        springs.follow(jnp.zeros((3, 2)), frequency=10.0, damping=1.5, dt=0.1)
