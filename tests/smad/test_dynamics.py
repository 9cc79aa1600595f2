"""The driven mass-spring-damper system: what it does without a network, and what the world's frame does not change."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.smad import config as configs
from avatarjax.smad import driving, dynamics, graph
from avatarjax.smad.driving import Pose
from avatarjax.smad.dynamics import Scaling, System
from tests.parameters import random_like

JOINTS = 3
CONFIG = dynamics.sized(configs.preset("ci"), JOINTS)


@pytest.fixture(scope="module")
def system():
    points = np.random.default_rng(0).normal(size=(24, 3)) * 0.3
    size = CONFIG.deformer.pose
    one = jnp.ones(())
    return System(
        graph.build(points, 4), None, Scaling(jnp.zeros(size), jnp.ones(size), 0.05 * one, 0.5 * one, 5 * one, 10 * one)
    )


@pytest.fixture(scope="module")
def quiet(system):
    """A fresh system, whose network as good as adds nothing: here it adds nothing at all."""
    params = dynamics.init(CONFIG, system, jax.random.key(0))
    heads = jax.tree.map(jnp.zeros_like, params["deformer"]["network"]["heads"])
    network = params["deformer"]["network"] | {"heads": heads}
    return params | {"deformer": params["deformer"] | {"network": network}}


def moving(frames, acceleration=(0.0, 0.0, 0.0), yaw=0.0):
    time = CONFIG.dt * jnp.arange(frames)
    turn = rotations.yaw_matrix(jnp.asarray(yaw))
    path = 0.5 * time[:, None] ** 2 * jnp.asarray(acceleration)[None] @ turn.T
    return Pose(jnp.tile(jnp.eye(3), (frames, JOINTS, 1, 1)), jnp.tile(turn, (frames, 1, 1)), path)


def first(poses):
    return jax.tree.map(lambda x: x[0], poses)


def roll(system, params, poses, offset=0.0):
    state = dynamics.reset(CONFIG, params, system, first(poses))
    state = state.replace(offset=state.offset + offset)
    return jax.jit(dynamics.rollout, static_argnums=0)(CONFIG, params, system, state, poses)


def test_a_figure_that_stands_stays_where_its_pose_has_it(system, quiet):
    target = jax.random.normal(jax.random.key(1), quiet["target"].shape)
    state, moved = roll(system, quiet | {"target": 0.01 * target}, moving(20))
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-6)
    assert np.abs(moved[0] - system.graph.positions).max() > 1e-3
    np.testing.assert_allclose(state.velocities, 0.0, atol=1e-6)


def test_a_surface_that_accelerates_leaves_its_cloth_behind_by_what_its_springs_give_way(system, quiet):
    params = quiet | {"inertia": jnp.full(24, 0.7)}
    _, anchor = dynamics.springs(params, system.graph)
    state, _ = roll(system, params, moving(120, (0.0, 0.0, 2.0)))
    # All nodes lag alike, so that the springs between them rest: k o = -m a.
    np.testing.assert_allclose(state.offset[:, 2], -0.7 * 2.0 / anchor, rtol=0.02)
    np.testing.assert_allclose(state.offset[:, :2], 0.0, atol=1e-4)


def test_it_is_stable_at_any_constants(system, quiet):
    for seed in range(4):
        keys = jax.random.split(jax.random.key(seed), 3)
        names = ("anchor", "neighbour", "damping")
        wild = {n: 30 * jax.random.normal(k, quiet[n].shape) for n, k in zip(names, keys, strict=True)}
        start = jax.random.normal(jax.random.key(9), (24, 3))
        state, _ = roll(system, quiet | wild, moving(600), start)
        assert float(jnp.abs(state.offset).max()) < 30


def test_loose_nodes_swing_after_stiff_ones_have_stopped(system, quiet):
    loose = jnp.arange(24) % 2 == 0
    constants = {"anchor": jnp.where(loose, -4.0, 4.0), "damping": jnp.where(loose, -4.0, 4.0)}
    state, _ = roll(system, quiet | constants | {"neighbour": jnp.full_like(quiet["neighbour"], -9.0)}, moving(30), 0.1)
    left = np.abs(state.offset).max(axis=1) + np.abs(state.velocities[:, 0]).max(axis=1)
    assert left[loose].min() > 10 * left[~loose].max()


def test_the_rollout_turns_with_the_world(system):
    fresh = dynamics.init(CONFIG, system, jax.random.key(0))
    params = random_like(fresh, 1, 0.1)
    results = []
    for yaw, shift in ((0.0, 0.0), (1.9, 3.0)):
        poses = moving(12, (0.3, 0.0, 1.5), yaw)
        poses = poses.replace(root_translation=poses.root_translation + jnp.array([[shift, 0.0, -shift]]))
        results.append(roll(system, params, poses)[1])
    assert np.abs(np.diff(results[0], axis=0)).max() > 1e-3
    np.testing.assert_allclose(results[1], results[0], atol=2e-3)


def test_a_rollout_is_repeated_steps_and_can_be_batched(system, quiet):
    poses = moving(4, (0.0, 0.0, 3.0))
    _, whole = roll(system, quiet, poses)
    state = dynamics.reset(CONFIG, quiet, system, first(poses))
    for k in range(4):
        state, _ = dynamics.step(CONFIG, quiet, system, state, jax.tree.map(lambda x, k=k: x[k], poses))
    np.testing.assert_allclose(dynamics.positions(system, state), whole[-1], atol=1e-5)
    both = jax.tree.map(lambda x: jnp.stack([x, x]), dynamics.reset(CONFIG, quiet, system, first(poses)))
    _, twice = jax.vmap(lambda s: dynamics.rollout(CONFIG, quiet, system, s, poses))(both)
    np.testing.assert_allclose(twice[1], whole, atol=1e-5)


def test_springs_between_nodes_never_sum_to_more_than_their_bound(system, quiet):
    between, _ = dynamics.springs(quiet | {"neighbour": jnp.full_like(quiet["neighbour"], 50.0)}, system.graph)
    i, j = system.graph.edges.T
    sums = np.zeros(24)
    np.add.at(sums, i, between.stiffness)
    np.add.at(sums, j, between.stiffness)
    assert sums.max() <= dynamics.NEIGHBOUR * (1 + 1e-6)


def test_gradients_reach_every_kind_of_parameter(system):
    params = random_like(dynamics.init(CONFIG, system, jax.random.key(0)), 2)
    poses = moving(3, (0.0, 0.0, 3.0))

    def loss(params):
        state = dynamics.reset(CONFIG, params, system, first(poses))
        return jnp.mean(dynamics.rollout(CONFIG, params, system, state, poses)[1] ** 2)

    slopes = jax.jit(jax.grad(loss))(params)
    for name in ("target", "anchor", "neighbour", "damping", "inertia"):
        assert np.isfinite(slopes[name]).all() and np.abs(slopes[name]).max() > 0, name
    assert np.abs(slopes["deformer"]["network"]["edge"]["kernel"]).max() > 0


def test_without_velocities_it_still_knows_its_own(system):
    config = dataclasses.replace(CONFIG, deformer=dataclasses.replace(CONFIG.deformer, velocities=0))
    params = dynamics.init(config, system, jax.random.key(0))
    state = dynamics.reset(config, params, system, first(moving(2)))
    state, _ = dynamics.step(config, params, system, state, first(moving(2, (0.0, 0.0, 1.0))))
    assert state.velocities.shape == (24, 1, 3)


def test_the_pose_features_count_is_the_network_s():
    assert CONFIG.deformer.pose == driving.count(JOINTS)


def test_nodes_are_carried_by_an_equilibrium_that_moves_and_do_not_lag_behind_it(system, quiet):
    poses = moving(40, (0.0, 0.0, 3.0))
    params = quiet | {"target": 0.02 * jax.random.normal(jax.random.key(4), quiet["target"].shape)}
    state = dynamics.reset(CONFIG, params, system, first(poses))
    for k in range(12):
        state, _ = dynamics.step(CONFIG, params, system, state, jax.tree.map(lambda x, k=k: x[k], poses))
        np.testing.assert_allclose(state.offset, state.equilibrium[0], atol=2e-5)
    assert np.abs(state.equilibrium[0] - state.equilibrium[1]).max() > 1e-4


def test_direct_changes_are_places_about_the_equilibrium_and_refine_velocities(system):
    config = dataclasses.replace(CONFIG, motion="deltas")
    params = random_like(dynamics.init(config, system, jax.random.key(0)), 3, 0.05)
    start = dynamics.reset(config, params, system, first(moving(2)))
    state, deltas = dynamics.step(config, params, system, start, first(moving(2)))
    np.testing.assert_allclose(state.offset, state.equilibrium[0] + system.scaling.offset * deltas.position, atol=1e-6)
    moved = (state.offset - start.offset) / config.dt
    np.testing.assert_allclose(state.velocities[:, 0], moved + system.scaling.velocity * deltas.velocity, atol=1e-5)


def test_without_an_equilibrium_poses_alone_say_nothing(system, quiet):
    config = dataclasses.replace(CONFIG, equilibrium=False)
    params = quiet | {"target": jnp.ones_like(quiet["target"])}
    state = dynamics.reset(config, params, system, first(moving(2)))
    np.testing.assert_array_equal(state.offset, 0.0)


def test_a_window_of_poses_may_be_spread_out(system):
    config = dataclasses.replace(CONFIG, deformer=dataclasses.replace(CONFIG.deformer, pose_window=3, pose_stride=4))
    assert config.deformer.pose_span == 9
    params = random_like(dynamics.init(config, system, jax.random.key(0)), 5, 0.1)
    window = jax.random.normal(jax.random.key(6), (9, config.deformer.pose))
    changed = [dynamics.settled(config, params, system, window.at[k].add(1.0)) for k in (4, 5)]
    rest = dynamics.settled(config, params, system, window)
    assert np.abs(changed[0] - rest).max() > 1e-3
    np.testing.assert_array_equal(changed[1], rest)
