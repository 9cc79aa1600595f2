"""The contract of an avatar that answers keys: pure, and the same by steps, by scan, in batches and when jitted."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import posmap, unica
from avatarjax.posmap import pca
from avatarjax.unica.coefficients import CoefficientDenoiser
from avatarjax.unica.denoiser import Denoiser
from avatarjax.unica.latent import LatentDynamics
from tests.parameters import random_params

ACTIONS = np.array([1, 1, 3, 0], np.int32)
roll = jax.jit(unica.rollout)
one_step = jax.jit(unica.step)


def assert_same(a, b, atol=0.0):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_allclose(x, y, atol=atol, rtol=atol, err_msg=jax.tree_util.keystr(path))


@pytest.fixture(scope="module")
def cached():
    return {}


@pytest.fixture
def start(avatar, key):
    return unica.reset(avatar, key)


@pytest.fixture
def rolled(avatar, start, cached):
    """The state and frames of one rollout with Gaussians, once for each model."""
    if avatar.config.dynamics not in cached:
        cached[avatar.config.dynamics] = roll(avatar, start, ACTIONS)
    return cached[avatar.config.dynamics]


def texels_of(avatar, frames):
    return jax.vmap(lambda m: posmap.from_map(avatar.atlas, m))(frames.posmap)


def test_shapes_and_finiteness(avatar, rolled):
    _, frames = rolled
    n = len(avatar.upscaler.rows)
    assert frames.posmap.shape == (4, 32, 32, 3) and frames.root.shape == (4, 3)
    assert frames.gaussians.means.shape == (4, n, 3) and frames.gaussians.quats.shape == (4, n, 4)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frames))


def test_reset_stands_three_times_at_the_standing_root(avatar, start):
    np.testing.assert_allclose(start.offset, posmap.root(avatar.atlas, avatar.standing), atol=1e-6)
    newest = jax.tree.leaves(start.context)
    for leaf in newest:
        np.testing.assert_array_equal(leaf, np.broadcast_to(leaf[-1], leaf.shape))


def test_a_rollout_is_repeated_steps(avatar, start, rolled):
    state, frames = start, []
    for action in ACTIONS:
        state, frame = one_step(avatar, state, jnp.asarray(action))
        frames.append(frame)
    assert_same(jax.tree.map(lambda *x: jnp.stack(x), *frames), rolled[1], 2e-4)
    assert_same(state, rolled[0], 2e-4)


def test_it_is_deterministic(avatar, start, rolled):
    assert_same(roll(avatar, start, ACTIONS), rolled)


def test_states_of_one_avatar_can_be_batched_without_gaussians(avatar, start, rolled):
    """Each of the batch as if alone, and the geometry as with Gaussians."""
    states = jax.vmap(lambda k: unica.reset(avatar, k))(jax.random.split(jax.random.key(9), 2))
    states = states.replace(key=jnp.stack([start.key, states.key[1]]))
    roll_geometry = jax.vmap(lambda s: unica.rollout(avatar, s, jnp.asarray(ACTIONS), gaussians=False))
    last, frames = jax.jit(roll_geometry)(states)
    assert frames.gaussians is None
    assert_same(jax.tree.map(lambda x: x[0], frames), rolled[1].replace(gaussians=None), 2e-4)
    assert_same(jax.tree.map(lambda x: x[0], last), rolled[0], 2e-4)
    assert np.abs(frames.posmap[1] - frames.posmap[0]).max() > 1e-5


def test_the_action_matters(avatar, start, rolled):
    other = roll(avatar, start, np.array([2, 1, 3, 0], np.int32))[1]
    assert np.abs(other.posmap[0] - rolled[1].posmap[0]).max() > 1e-5


def test_movement_accumulates(avatar, start, rolled):
    """Eq. 7: the root in the world is where it was, plus its displacement in normalised space over s."""
    offset = np.asarray(start.offset, np.float64)
    for texels, root in zip(texels_of(avatar, rolled[1]), rolled[1].root, strict=True):
        displacement = np.asarray(avatar.atlas.waist, np.float64) @ np.asarray(texels, np.float64) - 0.5
        offset = offset + displacement / float(avatar.atlas.scale)
        np.testing.assert_allclose(root, offset, atol=1e-4)
    np.testing.assert_allclose(rolled[0].offset, offset, atol=1e-4)


def test_the_newest_context_frame_is_the_origin(avatar, rolled):
    context = rolled[0].context
    if isinstance(avatar.dynamics, LatentDynamics):
        np.testing.assert_allclose(posmap.root(avatar.atlas, context[-1]), 0.5, atol=1e-5)
    else:
        np.testing.assert_allclose(context.root[-1, :2], 0, atol=1e-6)


def test_context_frames_keep_their_distances(avatar, rolled):
    """Renormalising moves all three frames alike (Eq. 8): their roots differ as the world roots do."""
    context, world = rolled[0].context, np.asarray(rolled[1].root[-3:])
    if isinstance(avatar.dynamics, LatentDynamics):
        roots = np.stack([posmap.root(avatar.atlas, c) for c in context]) / float(avatar.atlas.scale)
        np.testing.assert_allclose(np.diff(roots, axis=0), np.diff(world, axis=0), atol=1e-4)
    else:
        np.testing.assert_allclose(np.diff(context.root[:, :2], axis=0), np.diff(world[:, [0, 2]], axis=0), atol=1e-4)


def test_a_start_elsewhere_only_moves_the_ground(avatar, start, rolled):
    shift = jnp.asarray([100.0, 0.0, -50.0])
    moved = roll(avatar, start.replace(offset=start.offset + shift), ACTIONS)[1]
    np.testing.assert_allclose(moved.root - shift[None], rolled[1].root, atol=1e-3)
    np.testing.assert_allclose(moved.posmap, rolled[1].posmap, atol=1e-5)


def test_dressing_a_frame_gives_its_gaussians(avatar, rolled):
    frame = jax.tree.map(lambda x: x[2], rolled[1])
    assert_same(jax.jit(unica.dress)(avatar, frame.replace(gaussians=None)), frame.gaussians, 2e-4)


def aligned(avatar, texels):
    return texels if avatar.pca is None else pca.align(avatar.pca, texels)


def test_gaussians_are_where_the_aligned_texels_are_in_the_world(avatar, rolled):
    """A least-squares similarity keeps the centroid of the upscaled points; the texel head may move each a little."""
    points = posmap.upscale(avatar.upscaler, aligned(avatar, texels_of(avatar, rolled[1])[3]))
    origin = rolled[1].root[2]  # the root of the frame before
    world = np.asarray(posmap.denormalize(avatar.atlas, points, origin))
    means = np.asarray(rolled[1].gaussians.means[3])
    if avatar.config.appearance_model == "point_transformer":
        np.testing.assert_allclose(means.mean(0), world.mean(0), atol=1e-3)
    else:
        bound = np.sqrt(3) * avatar.config.texel_head.offset_bound
        assert 1e-4 < np.linalg.norm(means - world, axis=1).max() < bound + 1e-3


def test_info_tells_how_far_alignment_moves_and_the_lowest_texel(avatar, start, rolled):
    texels = texels_of(avatar, rolled[1])[0]
    scale, info = float(avatar.atlas.scale), rolled[1].info
    outside = np.asarray(texels - aligned(avatar, texels), np.float64) / scale
    assert float(info.pca_residual[0]) == pytest.approx(np.sqrt((outside**2).sum(1).mean()), rel=1e-2, abs=1e-4)
    assert (info.pca_residual[0] > 1e-3) == (avatar.pca is not None)
    lowest = (float(texels[:, 1].min()) - 0.5) / scale + float(start.offset[1])
    assert float(info.ground[0]) == pytest.approx(lowest, abs=1e-4)


def looking_at_two(avatar):
    """The avatar with a model of two context frames."""
    config = avatar.config
    if isinstance(avatar.dynamics, LatentDynamics):
        denoiser = dataclasses.replace(config.latent.denoiser, context=2)
        dynamics = avatar.dynamics.replace(denoiser=random_params(Denoiser, denoiser))
        config = dataclasses.replace(config, latent=dataclasses.replace(config.latent, denoiser=denoiser))
    else:
        settings = dataclasses.replace(config.coefficients, context=2)
        dynamics = avatar.dynamics.replace(params=random_params(CoefficientDenoiser, settings, scale=0.1))
        config = dataclasses.replace(config, coefficients=settings)
    return avatar.replace(dynamics=dynamics, config=config)


def test_a_model_of_two_context_frames_rolls_out_from_the_same_state(avatar, start):
    """The state still has three, so that whatever keeps or makes one need not know."""
    few = looking_at_two(avatar)
    last, frames = jax.jit(lambda s: unica.rollout(few, s, jnp.asarray(ACTIONS), gaussians=False))(start)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frames))
    assert [x.shape for x in jax.tree.leaves(last.context)] == [x.shape for x in jax.tree.leaves(start.context)]
    oldest = jax.tree.map(lambda x: x.at[0].add(0.05), start.context)
    again = jax.jit(lambda s: unica.step(few, s, 1)[0].context)(start.replace(context=oldest))
    once = jax.jit(lambda s: unica.step(few, s, 1)[0].context)(start)
    assert_same(jax.tree.map(lambda x: x[-1], again), jax.tree.map(lambda x: x[-1], once), 1e-5)
