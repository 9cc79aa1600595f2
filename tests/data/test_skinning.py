"""Forward kinematics and skinning against their invariants and a float64 recursion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatarjax import rotations
from avatarjax.data import body as bodies
from avatarjax.data import skinning

KINEMATICS = jax.jit(skinning.forward_kinematics)


@pytest.fixture(scope="module")
def figure():
    body = bodies.load_body()
    vertices, rig = bodies.shape(body, {"caucasian-female-young": 1.0})
    return vertices, rig, skinning.skinning_basis(jnp.asarray(vertices), jnp.asarray(body.skin_weights))


def identity(rig):
    return jnp.zeros((len(rig.names), 4)).at[:, 0].set(1.0)


def test_the_rest_pose_is_the_identity(figure):
    _, rig, _ = figure
    transforms = KINEMATICS(rig, identity(rig), jnp.asarray(rig.heads[0]))
    np.testing.assert_allclose(transforms, np.broadcast_to(np.eye(3, 4), transforms.shape), atol=1e-6)


def test_skinning_the_rest_pose_gives_the_rest_mesh(figure):
    vertices, rig, basis = figure
    transforms = KINEMATICS(rig, identity(rig), jnp.asarray(rig.heads[0]))
    np.testing.assert_allclose(skinning.skin(basis, transforms), vertices, atol=1e-5)


def test_turning_the_hips_turns_the_whole_mesh_about_them(figure):
    vertices, rig, basis = figure
    quat = rotations.from_axis_angle(jnp.array([0.2, -0.9, 0.4]))
    hips = jnp.array([1.0, 2.0, -0.5])
    transforms = KINEMATICS(rig, identity(rig).at[0].set(quat), hips)
    want = (vertices - rig.heads[0]) @ np.asarray(rotations.to_matrix(quat)).T + np.asarray(hips)
    np.testing.assert_allclose(skinning.skin(basis, transforms), want, atol=1e-5)


def test_kinematics_match_a_float64_recursion(figure):
    _, rig, _ = figure
    quats = np.random.default_rng(0).normal(size=(len(rig.names), 4))
    local = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    hips = np.array([0.1, 0.9, 0.2])
    turn, place = [], []
    for j, p in enumerate(rig.parents):
        turn.append(local[j] if p < 0 else turn[p] @ local[j])
        place.append(hips if p < 0 else place[p] + turn[p] @ (rig.heads[j] - rig.heads[p]).astype(float))
    transforms = KINEMATICS(rig, jnp.asarray(quats, jnp.float32), jnp.asarray(hips, jnp.float32))
    np.testing.assert_allclose(transforms[..., :3], np.stack(turn), atol=2e-5)
    np.testing.assert_allclose(skinning.joint_positions(rig, transforms), np.stack(place), atol=2e-5)


def test_bones_keep_their_lengths(figure):
    _, rig, _ = figure
    quats = jax.random.normal(jax.random.key(3), (len(rig.names), 4))
    joints = np.asarray(skinning.joint_positions(rig, KINEMATICS(rig, quats, jnp.zeros(3))))
    parents = np.array(rig.parents[1:])
    want = np.linalg.norm(rig.heads[1:] - rig.heads[parents], axis=1)
    np.testing.assert_allclose(np.linalg.norm(joints[1:] - joints[parents], axis=1), want, atol=1e-5)


def test_gradients_are_finite_at_the_rest_pose(figure):
    vertices, rig, basis = figure

    def loss(quats):
        transforms = skinning.forward_kinematics(rig, quats, jnp.asarray(rig.heads[0]))
        return jnp.sum((skinning.skin(basis, transforms) - vertices + 0.01) ** 2)

    assert np.isfinite(jax.jit(jax.grad(loss))(identity(rig))).all()


def test_the_joints_of_a_recorded_motion_are_those_of_each_frame(figure):
    _, rig, _ = figure
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(4, len(rig.names), 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=-1, keepdims=True)
    hips = rng.normal(size=(4, 3)).astype(np.float32)
    paths = skinning.joint_paths(rig, quats, hips)
    np.testing.assert_allclose(paths[:, rig.index("Hips")], hips, atol=1e-6)
    for k in range(4):
        expected = skinning.joint_positions(rig, KINEMATICS(rig, quats[k], hips[k]))
        np.testing.assert_allclose(paths[k], expected, atol=1e-5)


def test_feet_are_soles_and_balls_of_every_frame(figure):
    _, rig, _ = figure
    transforms = jnp.stack([KINEMATICS(rig, identity(rig), jnp.array([0.0, h, 0.0])) for h in (0.0, 1.0)])
    feet = skinning.feet(rig, transforms)
    for k in range(2):
        np.testing.assert_allclose(feet.soles[k], skinning.sole_points(rig, transforms[k]), atol=1e-6)
    np.testing.assert_allclose(feet.balls[1] - feet.balls[0], [[0, 1, 0]] * 2, atol=1e-6)
    assert (feet.balls[:, 0, 0] > 0).all() and (feet.balls[:, 1, 0] < 0).all()
    toes = feet.toes
    assert toes.shape[2] == feet.soles.shape[2] // 2 and toes[..., 2].mean() > feet.soles[..., 2].mean()
