import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import functional
from avatarjax.unica import appearance
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
