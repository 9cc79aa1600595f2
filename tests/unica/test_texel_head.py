"""The texel head: what an untrained one changes, that it turns and moves with the figure, and its bounds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, rotations
from avatarjax.gaussians import transform
from avatarjax.unica import texel_head
from avatarjax.unica.avatar import wear_base


@pytest.fixture(scope="module")
def avatar(avatars):
    """With Gaussians that are flat: how round ones are turned does not show."""
    one = avatars["coefficients"]
    return one.replace(base=one.base.replace(log_scales=one.base.log_scales + jnp.asarray([[0.5, 0.0, -1.0]])))


@pytest.fixture(scope="module")
def posed(tiny_data):
    """Texels of a running frame in the world."""
    train = tiny_data.train
    frame = int(np.flatnonzero(train.actions == 1)[20])
    return jnp.asarray(train.texels[frame] + train.roots[frame])


def wear(avatar, params, texels, **changes):
    config = dataclasses.replace(avatar.config.texel_head, **changes)
    surface = avatar.upscaler, avatar.tangents, avatar.standing
    root = posmap.root(avatar.atlas, texels)
    return jax.jit(texel_head.wear, static_argnums=0)(config, params, avatar.base, *surface, texels, root)


@pytest.fixture(scope="module")
def fresh(avatar):
    return texel_head.init(avatar.config.texel_head, len(avatar.atlas.rows), jax.random.key(0))


def covariances(cloud):
    axes = rotations.to_matrix(cloud.quats)
    return np.asarray(jnp.einsum("nij,nj,nkj->nik", axes, jnp.exp(2 * cloud.log_scales), axes))


def test_on_the_standing_pose_an_untrained_head_wears_the_base(avatar, fresh):
    found, expected = wear(avatar, fresh, avatar.standing), wear_base(avatar, avatar.standing)
    for name in ("means", "colors", "log_scales", "logit_opacities"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=2e-4, err_msg=name)
    np.testing.assert_allclose(covariances(found), covariances(expected), atol=1e-7)


def test_an_untrained_head_puts_gaussians_on_the_surface_of_any_pose(avatar, fresh, posed):
    found = wear(avatar, fresh, posed)
    np.testing.assert_allclose(found.means, posmap.upscale(avatar.upscaler, posed), atol=1e-5)
    np.testing.assert_array_equal(found.colors, avatar.base.colors)


def test_gaussians_turn_and_move_with_the_figure(avatar, fresh):
    """A standing figure that is turned as a whole wears its turned cloud; without turning it would not."""
    turn = rotations.from_axis_angle(jnp.asarray([0.0, 2.0, 0.0]))
    matrix, shift = rotations.to_matrix(turn), jnp.asarray([1.0, 0.0, -3.0])
    moved = avatar.standing @ matrix.T + shift[None]
    expected = transform(wear(avatar, fresh, avatar.standing), 1.0, matrix, shift)
    found = wear(avatar, fresh, moved)
    known = np.repeat(posmap.frames(avatar.tangents, avatar.standing).known > 0, len(expected.means) // len(moved))
    np.testing.assert_allclose(found.means, expected.means, atol=1e-4)
    difference = np.abs(covariances(found) - covariances(expected))[known]
    assert difference.max() < 0.01 * covariances(expected).max()
    unturned = wear(avatar, fresh, moved, turn=False)
    assert np.abs(covariances(unturned) - covariances(expected)).max() > 0.1 * covariances(expected).max()


def test_a_trained_head_corrects_every_attribute_within_its_bound(avatar, head, fresh, posed):
    plain, corrected = wear(avatar, fresh, posed), wear(avatar, head, posed)
    for name in ("means", "colors", "log_scales", "logit_opacities"):
        assert np.abs(getattr(corrected, name) - getattr(plain, name)).max() > 1e-4, name
    bound = np.sqrt(3) * avatar.config.texel_head.offset_bound
    assert np.linalg.norm(corrected.means - plain.means, axis=1).max() <= bound + 1e-6


def test_its_place_in_the_world_does_not_matter(avatar, head, posed):
    shift = jnp.asarray([20.0, 0.0, -7.0])
    here, there = wear(avatar, head, posed), wear(avatar, head, posed + shift[None])
    np.testing.assert_allclose(there.means - shift[None], here.means, atol=1e-4)
    np.testing.assert_allclose(there.colors, here.colors, atol=1e-3)


def test_its_gradient_is_finite_and_reaches_every_parameter(avatar, head, posed):
    def loss(params):
        cloud = wear(avatar, params, posed)
        return sum(jnp.sum(x**2) for x in (cloud.means, cloud.colors, cloud.log_scales, cloud.logit_opacities))

    slope = jax.grad(loss)(head)
    for leaf in jax.tree.leaves(slope):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0
