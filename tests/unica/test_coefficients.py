"""Canonical coordinates, what a key asks for, and that the model does not know where in the world it is."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.posmap import pca
from avatarjax.unica import coefficients as co
from avatarjax.unica import fit
from avatarjax.unica.coefficients import Context
from tests.parameters import random_params

sample = jax.jit(co.sample, static_argnums=0)


@pytest.fixture(scope="module")
def contexts(coefficient_frames, coefficient_dynamics):
    """Five true contexts of different sequences, in the world."""
    flat, roots = coefficient_frames
    rows = np.array([10, 100, 400, 700, 1000])[:, None] + np.arange(3)
    poses = pca.project(coefficient_dynamics.basis, jnp.asarray(flat[rows]))
    return Context(poses, jnp.asarray(roots[rows]))


def test_canonical_texels_come_back_through_a_full_basis(tiny_data, coefficient_dynamics):
    world = jnp.asarray(tiny_data.train.texels[30] + tiny_data.train.roots[30]) + jnp.array([[3.0, 0.0, -7.0]])
    flat, root = co.canonical(tiny_data.atlas, world)
    size = flat.shape[0]
    full = pca.PCA(jnp.zeros(size), jnp.eye(size), jnp.ones(size))
    back = co.world_texels(coefficient_dynamics.replace(basis=full), flat, root)
    np.testing.assert_allclose(back, world, atol=1e-5)


def test_canonical_texels_do_not_know_place_and_heading(tiny_data):
    world = jnp.asarray(tiny_data.train.texels[30] + tiny_data.train.roots[30])
    flat, root = co.canonical(tiny_data.atlas, world)
    moved = world @ rotations.yaw_matrix(jnp.asarray(1.1)).T + jnp.array([[3.0, 0.0, -7.0]])
    again, turned = co.canonical(tiny_data.atlas, moved)
    np.testing.assert_allclose(again, flat, atol=1e-4)
    assert float(turned[2] - root[2]) == pytest.approx(1.1, abs=1e-4)


def test_canonical_texels_keep_their_height(tiny_data):
    world = jnp.asarray(tiny_data.train.texels[30] + tiny_data.train.roots[30])
    flat, _ = co.canonical(tiny_data.atlas, world)
    np.testing.assert_allclose(flat.reshape(-1, 3)[:, 1], world[:, 1], atol=1e-6)


def test_compose_undoes_relative(key):
    a, b = jax.random.normal(key, (2, 6, 3))
    np.testing.assert_allclose(co.compose(b, co.relative(a, b)), a, atol=1e-5)
    np.testing.assert_allclose(co.relative(co.compose(b, a), b), a, atol=1e-5)


def test_a_step_ahead_goes_where_the_heading_points():
    """Facing +x (a quarter turn), one metre ahead is one metre along x."""
    there = co.compose(jnp.array([2.0, 5.0, np.pi / 2]), jnp.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(there, [3.0, 5.0, np.pi / 2], atol=1e-6)


def test_keys_are_seen_from_the_heading(coefficient_dynamics):
    yaw = jnp.array([0.4, np.pi / 2 + 0.4])
    features = co.action_features(coefficient_dynamics, jnp.array([1, 3]), yaw)
    np.testing.assert_allclose(features[0], features[1], atol=1e-5)
    np.testing.assert_allclose(features[0], [1, 0, np.cos(0.4), -np.sin(0.4), np.cos(0.8), -np.sin(0.8)], atol=1e-5)
    still = co.action_features(coefficient_dynamics, jnp.array([0]), yaw[:1])
    np.testing.assert_allclose(still, [[0, 1, 0, 0, 0, 0]])


def test_turning_the_world_turns_what_is_sampled(config, coefficient_dynamics, contexts, key):
    action = jnp.array([0, 1, 2, 3, 4])
    pose, root = sample(config.coefficients, coefficient_dynamics, key, contexts, action)
    turn = 0.8
    matrix = jnp.asarray([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]], jnp.float32)

    def turned(roots):
        ground = roots[..., :2] @ matrix.T + jnp.broadcast_to(jnp.array([4.0, -3.0]), roots[..., :2].shape)
        return jnp.concatenate([ground, roots[..., 2:] + turn], -1)

    world = coefficient_dynamics.replace(action_yaw=coefficient_dynamics.action_yaw + turn)
    pose_turned, root_turned = sample(
        config.coefficients, world, key, contexts.replace(root=turned(contexts.root)), action
    )
    np.testing.assert_allclose(pose_turned, pose, atol=1e-3)
    np.testing.assert_allclose(root_turned, turned(root), atol=1e-3)


@pytest.mark.parametrize("count", [1, 2])
def test_with_fewer_context_frames_older_ones_do_not_matter(config, coefficient_dynamics, contexts, key, count):
    settings = dataclasses.replace(config.coefficients, context=count)
    dynamics = coefficient_dynamics.replace(params=random_params(co.CoefficientDenoiser, settings, scale=0.1))
    action = jnp.array([0, 1, 2, 3, 4])
    before = sample(settings, dynamics, key, contexts, action)[0]

    def moved(frame):
        other = contexts.replace(pose=contexts.pose.at[:, frame].add(0.1))
        return np.abs(sample(settings, dynamics, key, other, action)[0] - before).max()

    assert [moved(frame) > 1e-5 for frame in range(3)] == [frame >= 3 - count for frame in range(3)]


def test_another_key_draws_another_sample(config, coefficient_dynamics, contexts, key):
    action = jnp.array([0, 1, 2, 3, 4])
    one, _ = sample(config.coefficients, coefficient_dynamics, key, contexts, action)
    other, _ = sample(config.coefficients, coefficient_dynamics, jax.random.key(1), contexts, action)
    assert np.abs(one - other).max() > 1e-4


def test_pushing_drops_the_oldest_frame(contexts):
    pushed = co.push(contexts, jnp.zeros((5, 12)), jnp.ones((5, 3)))
    np.testing.assert_array_equal(pushed.pose[:, :2], contexts.pose[:, 1:])
    np.testing.assert_array_equal(pushed.pose[:, 2], 0)
    np.testing.assert_array_equal(pushed.root[:, 2], 1)


def test_noise_keeps_the_newest_root_and_clean_contexts(config, coefficient_dynamics, contexts, key):
    many = jax.tree.map(lambda x: jnp.tile(x, (60, *[1] * (x.ndim - 1))), contexts)
    noised, level = jax.jit(co.noised_context, static_argnums=0)(
        config.coefficients, coefficient_dynamics.scaling, key, many
    )
    np.testing.assert_array_equal(noised.root[:, 2], many.root[:, 2])
    clean = np.asarray(level == 0).all(1)
    assert clean.mean() == pytest.approx(config.coefficients.clean_contexts, abs=0.08)
    np.testing.assert_array_equal(noised.pose[clean], many.pose[clean])
    assert float(level.max()) <= config.coefficients.context_noise
    assert np.abs(noised.pose[~clean] - many.pose[~clean]).max() > 0


class TestRidge:
    """On a motion x' = x + A (x - x_before), which a linear rule predicts exactly."""

    @pytest.fixture(scope="class")
    @staticmethod
    def motion(coefficient_dynamics):
        rng = np.random.default_rng(0)
        k, frames = 12, 600
        rotation, _ = np.linalg.qr(rng.normal(size=(k, k)))
        poses = [rng.normal(size=k), rng.normal(size=k)]
        for _ in range(frames - 2):
            poses.append(poses[-1] + 0.98 * rotation @ (poses[-1] - poses[-2]) + 0.02 * rng.normal(size=k))
        poses = np.asarray(poses, np.float32)
        steps = 0.05 + 0.01 * rng.normal(size=frames)
        roots = np.stack([np.zeros(frames), np.cumsum(steps), np.zeros(frames)], -1).astype(np.float32)
        scaling = fit.coefficient_scaling(poses, roots, np.zeros(frames, np.int32))
        rows = np.arange(frames - 3)[:, None] + np.arange(4)
        return poses[rows], roots[rows], coefficient_dynamics.replace(scaling=scaling)

    def test_it_predicts_better_than_copying(self, config, motion):
        poses, roots, dynamics = motion
        context = Context(jnp.asarray(poses[:, :3]), jnp.asarray(roots[:, :3]))
        args = (config.coefficients, dynamics, context, jnp.asarray(poses[:, 3]), jnp.asarray(roots[:, 3]))
        params = fit.ridge_start(*args, jax.random.key(0), noise=0.0)
        newest = jnp.broadcast_to(context.root[:, 2:], context.root.shape)
        features = co.context_features(dynamics.scaling, context.pose, co.relative(context.root, newest))
        kernel = params["linear"]["kernel"]
        step = features @ kernel[: features.shape[1]] + params["linear"]["bias"][None]
        pose_error = step[:, :12] * dynamics.scaling.step_scale[None] - (poses[:, 3] - poses[:, 2])
        assert float(jnp.abs(pose_error).mean()) < 0.3 * np.abs(poses[:, 3] - poses[:, 2]).mean()
        ahead = step[:, 13] * dynamics.scaling.root_scale[1]
        assert float(jnp.abs(ahead - (roots[:, 3, 1] - roots[:, 2, 1])).mean()) < 0.02

    def test_the_noisy_increment_is_not_used_and_other_weights_stay(self, config, motion):
        poses, roots, dynamics = motion
        context = Context(jnp.asarray(poses[:50, :3]), jnp.asarray(roots[:50, :3]))
        target = jnp.asarray(poses[:50, 3]), jnp.asarray(roots[:50, 3])
        params = fit.ridge_start(config.coefficients, dynamics, context, *target, jax.random.key(0))
        np.testing.assert_array_equal(params["linear"]["kernel"][-config.coefficients.features :], 0)
        rest = {k: v for k, v in params.items() if k != "linear"}
        jax.tree.map(np.testing.assert_array_equal, rest, {k: dynamics.params[k] for k in rest})


class TestActionDirections:
    roots = np.zeros((200, 3))
    actions = np.repeat([0, 1], 100)
    roots[100:, 0] = 0.1 * np.arange(100)
    sequence = np.repeat([0, 1], 100)

    def test_directions_and_movement_are_measured(self):
        yaw, moves = fit.action_directions(self.roots, self.actions, self.sequence, 2)
        assert yaw[1] == pytest.approx(np.pi / 2)
        np.testing.assert_array_equal(moves, [0, 1])

    def test_an_action_that_is_never_held_is_named(self):
        with pytest.raises(ValueError, match=r"no sequence holds action 2 .*record longer"):
            fit.action_directions(self.roots, self.actions, self.sequence, 3)


def test_scaling_brings_increments_to_unit_size(coefficient_frames, coefficient_dynamics, tiny_data):
    flat, _ = coefficient_frames
    poses = np.asarray(pca.project(coefficient_dynamics.basis, jnp.asarray(flat)))
    same = tiny_data.train.sequence[1:] == tiny_data.train.sequence[:-1]
    scaling = coefficient_dynamics.scaling
    steps = np.diff(poses, axis=0)[same] / np.asarray(scaling.step_scale)
    assert (steps.std(0) <= 1.01).all() and steps.std(0)[0] == pytest.approx(1, abs=0.01)
    np.testing.assert_allclose(np.mean(scaling.weight), 1, rtol=1e-5)


def test_without_temperature_nothing_is_left_to_chance(config, coefficient_dynamics, contexts, key):
    cold = dataclasses.replace(config.coefficients, temperature=0.0)
    dynamics = coefficient_dynamics.replace(params=random_params(co.CoefficientDenoiser, cold, scale=0.05))
    one, other = (sample(cold, dynamics, k, contexts, jnp.ones(5, jnp.int32))[0] for k in (key, jax.random.key(1)))
    np.testing.assert_array_equal(one, other)


def test_a_temperature_out_of_range_is_refused():
    with pytest.raises(ValueError, match=r"the temperature is 1\.5"):
        co.CoefficientConfig(temperature=1.5)


def test_training_does_not_depend_on_how_an_avatar_samples(config, coefficient_dynamics, contexts, key):
    target = jnp.repeat(contexts.pose[:, 2:], 2, 1), jnp.repeat(contexts.root[:, 2:], 2, 1)
    loss = jax.jit(co.rollout_loss, static_argnums=0)
    ways = (dict(sample_steps=1, temperature=1.0), dict(sample_steps=3, temperature=0.2))
    settings = (dataclasses.replace(config.coefficients, **way) for way in ways)
    one, other = (loss(s, coefficient_dynamics, key, contexts, *target, jnp.ones((5, 2), jnp.int32)) for s in settings)
    assert one == other


def test_losses_are_finite_and_have_gradients(config, coefficient_dynamics, contexts, key):
    settings = dataclasses.replace(config.coefficients, sample_steps=1)
    params = random_params(co.CoefficientDenoiser, settings, scale=0.05)

    @jax.jit
    @jax.value_and_grad
    def loss(params):
        dynamics = coefficient_dynamics.replace(params=params)
        target = jnp.repeat(contexts.pose[:, 2:], 2, 1), jnp.repeat(contexts.root[:, 2:], 2, 1)
        return co.rollout_loss(settings, dynamics, key, contexts, *target, jnp.ones((5, 2), jnp.int32))

    value, gradient = loss(params)
    assert np.isfinite(value) and float(value) > 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.abs(gradient["leave"]["kernel"]).max() > 0
