"""The verbs of a SMAD avatar, as other JAX code uses them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.data.body import Rig
from avatarjax.gaussians import Gaussians
from avatarjax.io import weights
from avatarjax.smad import avatar as smad
from avatarjax.smad import config as configs
from avatarjax.smad import drape, dynamics, embedded, files, graph, kernel, skeletal
from avatarjax.smad.deformer import Deltas
from avatarjax.smad.driving import Pose
from avatarjax.smad.dynamics import Scaling, System
from tests.parameters import random_like

JOINTS, NODES = 2, 20
CONFIG = dynamics.sized(configs.preset("ci"), JOINTS)


def motion(frames, yaw=0.0, shift=0.0):
    ahead = 0.05 * jnp.arange(frames)[:, None] * jnp.array([[0.0, 0.0, 1.0]])
    turn = rotations.yaw_matrix(jnp.asarray(yaw))
    place = ahead @ turn.T + shift * jnp.array([[1.0, 0.0, -1.0]])
    return Pose(jnp.tile(jnp.eye(3), (frames, JOINTS, 1, 1)), jnp.tile(turn, (frames, 1, 1)), place)


def at(poses, k):
    return jax.tree.map(lambda x: x[k], poses)


@pytest.fixture(scope="module")
def avatar():
    rng = np.random.default_rng(0)
    net = graph.build(0.3 * rng.normal(size=(NODES, 3)), 4)
    size, one = CONFIG.deformer.pose, jnp.ones(())
    scaling = Scaling(jnp.zeros(size), jnp.ones(size), 0.05 * one, 0.5 * one, 5 * one, 10 * one)
    system = System(net, None, scaling)
    quats = rotations.normalize(jnp.asarray(rng.normal(size=(60, 4)), jnp.float32))
    means = jnp.asarray(0.3 * rng.normal(size=(60, 3)), jnp.float32)
    gaussians = Gaussians(means, jnp.full((60, 3), -4.0), quats, jnp.zeros(60), jnp.full((60, 3), 0.5, jnp.float32))
    params = random_like(dynamics.init(CONFIG, system, jax.random.key(0)), 1, 0.1)
    return smad.Avatar(gaussians, embedded.bind(gaussians, net), system, params, CONFIG)


@pytest.fixture(scope="module")
def rolled(avatar):
    poses = motion(5)
    return jax.jit(smad.rollout)(avatar, smad.reset(avatar, at(poses, 0)), poses)


def test_shapes_and_finiteness(rolled):
    _, frames = rolled
    assert frames.nodes.shape == (5, NODES, 3) and frames.gaussians.means.shape == (5, 60, 3)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(frames))
    assert np.abs(np.diff(frames.nodes, axis=0)).max() > 1e-4


def test_a_rollout_is_repeated_steps(avatar, rolled):
    poses, step = motion(5), jax.jit(smad.step)
    state = smad.reset(avatar, at(poses, 0))
    for k in range(5):
        state, frame = step(avatar, state, at(poses, k))
    np.testing.assert_allclose(frame.gaussians.means, rolled[1].gaussians.means[-1], atol=1e-5)


def test_the_look_of_a_gaussian_is_its_nearest_node_s(avatar):
    counted = jnp.arange(float(NODES))
    look = Deltas(*jnp.zeros((2, NODES, 3)), *jnp.tile(counted[:, None], (2, 1, 3)), counted)
    nearest = np.asarray(avatar.binding.nodes[:, 0])
    plain, seen = avatar.gaussians, smad.dressed(avatar, avatar.system.graph.positions, look)
    np.testing.assert_allclose(seen.means, plain.means, atol=1e-5)
    np.testing.assert_allclose(seen.log_scales[:, 0] - plain.log_scales[:, 0], nearest, atol=1e-5)
    np.testing.assert_allclose(seen.logit_opacities - plain.logit_opacities, nearest, atol=1e-5)
    np.testing.assert_allclose(seen.colors, np.minimum(plain.colors + nearest[:, None], 1))


def test_gaussians_turn_and_move_with_the_world(avatar, rolled):
    poses = motion(5, 2.0, 3.0)
    _, frames = jax.jit(smad.rollout)(avatar, smad.reset(avatar, at(poses, 0)), poses)
    turn = rotations.yaw_matrix(jnp.asarray(2.0))
    expected = rolled[1].gaussians.means @ turn.T + 3.0 * jnp.array([[[1.0, 0.0, -1.0]]])
    np.testing.assert_allclose(frames.gaussians.means, expected, atol=2e-3)


def test_states_of_one_avatar_can_be_batched(avatar, rolled):
    poses = motion(5)
    state = smad.reset(avatar, at(poses, 0))
    both = jax.tree.map(lambda x: jnp.stack([x, x]), state)
    _, frames = jax.jit(jax.vmap(lambda s: smad.rollout(avatar, s, poses, gaussians=False)))(both)
    assert frames.gaussians is None
    np.testing.assert_allclose(frames.nodes[1], rolled[1].nodes, atol=1e-5)


def test_a_file_keeps_the_avatar(avatar, tmp_path):
    poses, names, parents = motion(1), ("hips", "spine"), (-1, 0)
    rig = Rig(jnp.array([[0.0, 1.0, 0.0], [0.0, 1.2, 0.0]]), jnp.zeros((2, 3)), jnp.zeros((2, 0, 3)), names, parents)
    skinned = avatar.system.replace(skin=skeletal.bind(rig, at(poses, 0), avatar.system.graph.positions))
    features, first = jax.random.normal(jax.random.key(0), (20, CONFIG.deformer.pose)), jnp.zeros(20, int)
    known = dynamics.Known(kernel.fit(features, first), jnp.ones(CONFIG.deformer.pose_embedding))
    draped = skinned.replace(known=known, drape=drape.fit(jnp.ones((20, NODES, 3)), features, first, components=2))
    for whole in (avatar, avatar.replace(system=skinned), avatar.replace(system=draped)):
        files.save(tmp_path / "avatar.safetensors", whole)
        again = files.load(tmp_path)
        assert again.config == CONFIG
        assert jax.tree.structure(again) == jax.tree.structure(whole)
        jax.tree.map(np.testing.assert_array_equal, again, whole)


def test_a_file_that_is_none_is_refused(avatar, tmp_path):
    with pytest.raises(ValueError, match=r"experiments\.smad --avatar nobody"):
        files.load("nobody", runs=tmp_path)
    path = tmp_path / "avatar.safetensors"
    weights.save_tree(path, {"a": np.zeros(1)})
    with pytest.raises(ValueError, match=f"no SMAD avatar of version {files.VERSION}"):
        files.load(path)
    files.save(path, avatar)
    arrays, metadata = weights.load_arrays(path)
    weights.save_tree(path, weights.nest({k: v for k, v in arrays.items() if "binding" not in k}), **metadata)
    with pytest.raises(ValueError, match="lacks parts"):
        files.load(path)


def test_a_pose_of_another_body_is_refused(avatar):
    pose = at(motion(1), 0)
    with pytest.raises(ValueError, match=r"must be \(2, 3, 3\)"):
        smad.reset(avatar, pose.replace(rotations=jnp.tile(jnp.eye(3), (7, 1, 1))))
