"""The body frame and the features of poses: what turning and moving the world does, and does not, change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.smad import driving
from avatarjax.smad.driving import Pose

DT = 1 / 30


def motion(seed=0, frames=5, joints=3):
    keys = jax.random.split(jax.random.key(seed), 3)
    quats = rotations.normalize(jax.random.normal(keys[0], (frames, joints, 4)))
    tilts = rotations.from_axis_angle(0.3 * jax.random.normal(keys[1], (frames, 3)))
    return Pose(rotations.to_matrix(quats), rotations.to_matrix(tilts), jax.random.normal(keys[2], (frames, 3)))


def turned(poses, angle, shift):
    turn = rotations.yaw_matrix(jnp.asarray(angle))
    return poses.replace(
        root_rotation=turn[None] @ poses.root_rotation, root_translation=poses.root_translation @ turn.T + shift[None]
    )


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5, 3.1])
def test_yaw_of_a_turn_about_y_is_its_angle(angle):
    np.testing.assert_allclose(driving.yaw(rotations.yaw_matrix(jnp.asarray(angle))), angle, atol=1e-6)


def test_yaw_is_that_of_the_nearest_turn_about_y():
    rotation = motion().root_rotation[0]
    angles = np.linspace(-np.pi, np.pi, 20_001)
    distance = np.linalg.norm(np.asarray(rotations.yaw_matrix(jnp.asarray(angles))) - np.asarray(rotation), axis=(1, 2))
    np.testing.assert_allclose(driving.yaw(rotation), angles[distance.argmin()], atol=1e-3)


def test_to_world_undoes_to_body():
    poses = motion()
    points = jax.random.normal(jax.random.key(1), (5, 7, 3))
    np.testing.assert_allclose(driving.to_world(poses, driving.to_body(poses, points)), points, atol=1e-5)


def test_the_body_frame_turns_with_the_world():
    poses = motion()
    points = jax.random.normal(jax.random.key(1), (5, 7, 3))
    shift = jnp.array([1.0, 2.0, -3.0])
    there = points @ rotations.yaw_matrix(jnp.asarray(1.2)).T + shift[None, None]
    np.testing.assert_allclose(
        driving.to_body(turned(poses, 1.2, shift), there), driving.to_body(poses, points), atol=1e-5
    )


def test_features_do_not_change_when_the_world_turns_and_moves_along_the_ground():
    poses = motion()
    other = turned(poses, 2.9, jnp.array([4.0, 0.0, -1.0]))
    np.testing.assert_allclose(driving.track(other, DT), driving.track(poses, DT), atol=2e-4)


def test_features_tell_speed_turning_and_height():
    frames, speed, rate = 4, 1.5, 0.8
    angles = rate * DT * jnp.arange(frames)
    ahead = jnp.stack([jnp.zeros(frames), jnp.full(frames, 0.9), speed * DT * jnp.arange(frames)], 1)
    poses = Pose(jnp.tile(jnp.eye(3), (frames, 2, 1, 1)), rotations.yaw_matrix(angles), ahead)
    found = driving.track(poses, DT)
    assert found.shape == (frames, driving.count(2))
    np.testing.assert_allclose(found[1:, -2], rate, rtol=1e-4)
    np.testing.assert_allclose(found[:, -1], 0.9, rtol=1e-6)
    forwards = speed * np.cos(angles[1:])
    np.testing.assert_allclose(found[1:, -3], forwards, rtol=1e-4)
    np.testing.assert_allclose(found[0, -5:-1], 0.0, atol=1e-7)


def test_a_heading_that_passes_behind_turns_on():
    angles = jnp.array([np.pi - 0.05, np.pi + 0.05])
    poses = Pose(jnp.tile(jnp.eye(3), (2, 1, 1, 1)), rotations.yaw_matrix(angles), jnp.zeros((2, 3)))
    np.testing.assert_allclose(driving.track(poses, DT)[1, -2], 0.1 / DT, rtol=1e-3)
