"""Springs against closed forms."""

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
