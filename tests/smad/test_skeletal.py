"""Skinning by distances to bones: binding, rigid parts, and what does not change with the world."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.data.recording import Poses
from avatarjax.smad import skeletal
from avatarjax.smad.driving import Pose

JOINTS = np.array([[0, 1.0, 0], [0, 1.4, 0], [0.1, 0.9, 0], [0.1, 0.5, 0], [0.1, 0.1, 0]], np.float32)
PARENTS = (-1, 0, 0, 2, 3)
EYE = np.eye(3, dtype=np.float32)


def recorded(frames=1, **changes):
    turns = np.tile(EYE, (frames, len(JOINTS), 1, 1))
    known = {"parents": PARENTS, "joints": JOINTS} | changes
    return Poses(turns, turns[:, 0], np.zeros((frames, 3), np.float32), **known)


def pose(knee=0.0, yaw=0.0, place=(0.0, 0.0, 0.0), lean=0.0):
    turns = jnp.tile(jnp.eye(3), (len(JOINTS), 1, 1))
    bend = rotations.to_matrix(rotations.from_axis_angle(jnp.array([knee, 0.0, 0.0])))
    tilt = rotations.to_matrix(rotations.from_axis_angle(jnp.array([lean, 0.0, 0.0])))
    return Pose(turns.at[3].set(bend), rotations.yaw_matrix(jnp.asarray(yaw)) @ tilt, jnp.asarray(place))


POINTS = jnp.array([[0.12, -0.7, 0.01], [0.1, -0.3, 0.03], [0.0, 0.3, -0.02], [-0.3, 0.1, 0.2]])


@pytest.fixture(scope="module")
def skin():
    return skeletal.bind(skeletal.rig_of(recorded()), pose(knee=0.4), POINTS)


def test_weights_sum_to_one_and_prefer_the_nearest_bone():
    joints = jnp.asarray(JOINTS - JOINTS[0])
    weights = skeletal.inverse_distances(POINTS, joints, np.array(PARENTS), 4.0)
    np.testing.assert_allclose(weights.sum(1), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(weights.argmax(1)[:2], [3, 2])


def test_a_bone_is_as_near_as_its_nearest_point():
    weights = skeletal.inverse_distances(
        jnp.array([[1.0, 0.0, 0.0]]), jnp.array([[0.0, -1, 0], [0, 1, 0], [0, 5, 0]]), np.array([-1, 0, 1]), 1.0
    )
    # From the bone of the first joint 1 m, from the others' joints sqrt(2) and sqrt(26), a millimetre added to each.
    near = 1 / (np.array([1.0, np.sqrt(2), np.sqrt(26)]) + 1e-3)
    np.testing.assert_allclose(weights[0], near / near.sum(), rtol=1e-5)


def test_points_lie_where_they_were_bound(skin):
    np.testing.assert_allclose(skeletal.pose_points(skin, pose(knee=0.4)), POINTS, atol=1e-6)


def test_walking_and_turning_change_nothing_in_the_body_frame(skin):
    here = skeletal.pose_points(skin, pose(knee=1.0, lean=0.2))
    there = skeletal.pose_points(skin, pose(knee=1.0, lean=0.2, yaw=2.0, place=(3.0, 0.5, -1.0)))
    np.testing.assert_allclose(there, here, atol=1e-6)


def test_a_point_on_a_limb_turns_with_it(skin):
    still, bent = (skeletal.pose_points(skin, pose(knee=angle)) for angle in (0.4, 1.0))
    knee = jnp.array([0.1, -0.5, 0.0])
    turn = rotations.to_matrix(rotations.from_axis_angle(jnp.array([0.6, 0.0, 0.0])))
    # Close to the bone its own weight is nearly all there is; the chest has nothing of the knee.
    np.testing.assert_allclose(bent[0], turn @ (still[0] - knee) + knee, atol=5e-3)
    np.testing.assert_allclose(bent[2], still[2], atol=5e-3)


def test_it_can_be_batched_and_differentiated(skin):
    poses = jax.tree.map(lambda *x: jnp.stack(x), pose(0.1), pose(0.2))
    assert jax.vmap(skeletal.pose_points, in_axes=(None, 0))(skin, poses).shape == (2, 4, 3)
    slope = jax.grad(lambda angle: skeletal.pose_points(skin, pose(knee=angle)).sum())(0.3)
    assert np.isfinite(slope) and abs(slope) > 0.01


@pytest.mark.parametrize("missing", ["joints", "parents"])
def test_poses_without_a_skeleton_are_refused(missing):
    with pytest.raises(ValueError, match="joints and parents"):
        skeletal.rig_of(recorded(**{missing: None}))
