"""The skirt's blend of two legs, and where its cloth ends up."""

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax.data import avatars, draping

FRONT = jnp.tile(jnp.array([[0.0, 0.0, 1.0]]), (5, 1))
ACROSS = jnp.array([-0.2, -0.1, 0.0, 0.1, 0.2])
REST = jnp.stack([ACROSS, jnp.zeros(5), jnp.full(5, 0.2)], axis=1)


def test_copies_that_agree_stay_where_they_are():
    np.testing.assert_allclose(draping.drape(REST, REST, FRONT, ACROSS), REST, atol=1e-7)


def test_the_front_follows_the_leg_that_is_ahead_in_the_middle_and_each_leg_on_its_side():
    left, right = REST.at[:, 2].add(0.3), REST.at[:, 2].add(-0.2)
    cloth = np.asarray(draping.drape(left, right, FRONT, ACROSS)[:, 2])
    assert (cloth[2:] > 0.44).all()
    assert cloth[0] < 0.05


def test_the_back_follows_the_leg_that_is_behind():
    left, right = REST.at[:, 2].add(-0.4), REST
    cloth = np.asarray(draping.drape(left, right, -FRONT, ACROSS)[:, 2])
    assert (cloth[2:] < -0.15).all()


def test_mirroring_the_legs_mirrors_the_cloth():
    left, right = REST.at[:, 2].add(0.3), REST.at[:, 2].add(-0.1)
    flip = jnp.array([[-1.0, 1.0, 1.0]])
    cloth = draping.drape(left, right, FRONT, ACROSS)
    mirrored = draping.drape(right * flip, left * flip, FRONT, -ACROSS)
    np.testing.assert_allclose(mirrored, cloth * flip, atol=1e-6)


def test_posing_has_finite_gradients():
    avatar = avatars.build("cowgirl")
    rest = jnp.broadcast_to(jnp.eye(3, 4)[None], (len(avatar.rig.names), 3, 4))
    gradient = jax.jit(jax.grad(lambda t: jnp.sum(draping.pose(avatar.basis, t, t) ** 2)))(rest)
    assert np.isfinite(gradient).all()
