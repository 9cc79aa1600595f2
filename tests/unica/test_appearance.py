import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, rotations
from avatarjax.gaussians import transform
from avatarjax.nets import functional
from avatarjax.unica import appearance, avatar, reset, step
from avatarjax.unica.appearance import AppearanceNetwork
from tests.parameters import random_params

refine = jax.jit(appearance.refine, static_argnums=0)


@pytest.fixture(scope="module")
def coarse(base):
    points = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, (len(base.quats), 3)), jnp.float32)
    return appearance.coarse_gaussians(base, points, base.height)


def test_a_fresh_network_changes_nothing(config, coarse):
    fresh = functional.init(AppearanceNetwork, config.appearance, jax.random.key(0))
    refined = refine(config.appearance, fresh, coarse)
    jax.tree.map(np.testing.assert_array_equal, refined, coarse)


def test_every_attribute_can_be_refined_and_means_move_within_the_bound(config, coarse):
    params = random_params(AppearanceNetwork, config.appearance, scale=1.0)
    refined = refine(config.appearance, params, coarse)
    for name in appearance.ATTRIBUTES:
        assert np.abs(getattr(refined, name) - getattr(coarse, name)).max() > 1e-3, name
    moved = np.abs(np.asarray(refined.means - coarse.means))
    bound = config.appearance.offset_bound
    assert moved.max() <= bound + 1e-6 and moved.max() > 0.9 * bound


def test_on_the_standing_pose_coarse_gaussians_are_the_base(base, coarse):
    np.testing.assert_array_equal(coarse.log_scales, base.log_scales)
    np.testing.assert_array_equal(coarse.quats, base.quats)
    np.testing.assert_array_equal(coarse.colors, base.colors)


def test_a_taller_box_makes_smaller_gaussians(base, coarse):
    """B.1: sizes grow by H_s / H_p, so that they keep their size in metres."""
    half = appearance.coarse_gaussians(base, coarse.means, 2 * base.height)
    np.testing.assert_allclose(half.scales, coarse.scales / 2, rtol=1e-5)


def test_initial_sizes_follow_the_spacing_of_the_points():
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(6), [0], indexing="ij"), -1).reshape(-1, 3)
    points = jnp.asarray(0.1 * grid, jnp.float32)
    base = appearance.initial_base(points, jnp.asarray(1.0))
    assert float(jnp.median(base.log_scales)) == pytest.approx(np.log(0.1), abs=1e-4)
    assert (base.log_scales.max() - base.log_scales.min()) <= np.log(4) + 1e-5
    denser = appearance.initial_base(0.5 * points, jnp.asarray(1.0))
    np.testing.assert_allclose(denser.log_scales, base.log_scales - np.log(2), atol=1e-4)


@pytest.fixture(scope="module")
def painted(avatars):
    """The coefficient model's avatar with an untrained point transformer and long thin Gaussians."""
    one = avatars["coefficients"]
    stretch = jnp.asarray([[0.5, 0.0, -1.0]])
    return one.replace(
        appearance=functional.init(AppearanceNetwork, one.config.appearance, jax.random.key(0)),
        base=one.base.replace(log_scales=one.base.log_scales + stretch),
        config=dataclasses.replace(one.config, appearance_model="point_transformer"),
    )


def changed(one, **changes):
    settings = dataclasses.replace(one.config.appearance, **changes)
    return one.replace(config=dataclasses.replace(one.config, appearance=settings))


def covariances(cloud):
    axes = rotations.to_matrix(cloud.quats)
    return np.asarray(jnp.einsum("nij,nj,nkj->nik", axes, jnp.exp(2 * cloud.log_scales), axes))


def test_gaussians_turn_with_the_surface_where_they_are_told_to(painted):
    """UNICA E: a standing figure that is turned as a whole wears its turned cloud."""
    wear = jax.jit(avatar.wear)
    matrix = rotations.to_matrix(rotations.from_axis_angle(jnp.asarray([0.0, 2.0, 0.0])))
    moved = painted.standing @ matrix.T
    expected = covariances(transform(wear(painted, painted.standing), 1.0, matrix, jnp.zeros(3)))
    known = np.repeat(posmap.frames(painted.tangents, painted.standing).known > 0, len(expected) // len(moved))
    found = covariances(wear(changed(painted, turn=True), moved))
    assert np.abs(found - expected)[known].max() < 0.02 * expected.max()
    assert np.abs(covariances(wear(painted, moved)) - expected)[known].max() > 0.1 * expected.max()


def test_a_frame_says_for_how_many_voxels_there_was_no_room(painted):
    stepped = jax.jit(step)
    narrow = dataclasses.replace(painted.config.appearance.transformer, fill=0.05)
    for one, enough in ((painted, True), (changed(painted, transformer=narrow), False)):
        _, frame = stepped(one, reset(one, jax.random.key(0)), 1)
        assert (int(frame.info.overflow) == 0) == enough
        assert np.isfinite(frame.gaussians.means).all()
