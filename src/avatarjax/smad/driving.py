"""The signal that drives an avatar: body poses, the frame in which it is simulated, and what a network sees of them.

Everything is simulated in the body frame: its origin is the root, its y axis is the world's, and its z axis is the
root's heading. So gravity keeps its direction, walking through a scene changes nothing, and turning the world turns the
result. The paper's literal world-frame form diverged on our data.
"""

from __future__ import annotations

import functools
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax import rotations
from avatarjax.data.recording import Poses

MOTION = 11  # features of a frame beside its joints: tilt (6), root velocity (3), rate of turning (1), height (1)


@typing.no_type_check
@flax.struct.dataclass
class Pose:
    """A body pose, or a batch of them: joint rotations relative to their parents (j, 3, 3), the root's rotation (3, 3)
    and translation (3,) in the world, metres."""

    rotations: Float[Array, "*b j 3 3"]
    root_rotation: Float[Array, "*b 3 3"]
    root_translation: Float[Array, "*b 3"]


def recorded(poses: Poses) -> Pose:
    """The poses of all frames of a recording."""
    parts = poses.rotations, poses.root_rotation, poses.root_translation
    return Pose(*(jnp.asarray(part, jnp.float32) for part in parts))


def yaw(root_rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b"]:
    """Heading in radians, 0 towards +z and 90 degrees towards +x: of all turns about y the nearest to the rotation.

    Not determined for a figure upside down."""
    return jnp.arctan2(
        root_rotation[..., 0, 2] - root_rotation[..., 2, 0], root_rotation[..., 0, 0] + root_rotation[..., 2, 2]
    )


def to_body(pose: Pose, points: Float[Array, "*b n 3"]) -> Float[Array, "*b n 3"]:
    """World points in the body frame of each pose."""
    return (points - pose.root_translation[..., None, :]) @ rotations.yaw_matrix(yaw(pose.root_rotation))


def to_world(pose: Pose, points: Float[Array, "*b n 3"]) -> Float[Array, "*b n 3"]:
    """The inverse of `to_body`."""
    turn = jnp.swapaxes(rotations.yaw_matrix(yaw(pose.root_rotation)), -1, -2)
    return points @ turn + pose.root_translation[..., None, :]


def count(joints: int) -> int:
    """How many numbers `features` gives for a body of so many joints."""
    return 6 * joints + MOTION


def features(previous: Pose, pose: Pose, dt: float) -> Float[Array, "f"]:
    """What a network sees of one frame, in the body frame: two columns of every joint's rotation (Zhou et al. 2019, "On
    the continuity of rotation representations"), the same of the root without its heading, the root's velocity in
    metres a second, its turning in radians a second, and its height in metres."""
    heading = yaw(pose.root_rotation)
    turn = rotations.yaw_matrix(heading)
    tilt = turn.T @ pose.root_rotation
    velocity = (pose.root_translation - previous.root_translation) @ turn / dt
    turned = heading - yaw(previous.root_rotation)
    rate = jnp.arctan2(jnp.sin(turned), jnp.cos(turned)) / dt
    return jnp.concatenate(
        [
            pose.rotations[..., :2].reshape(-1),
            tilt[:, :2].reshape(-1),
            velocity,
            jnp.stack([rate, pose.root_translation[1]]),
        ]
    )


@functools.partial(jax.jit, static_argnames="dt")
def track(poses: Pose, dt: float) -> Float[Array, "t f"]:
    """`features` of every frame of a motion (t poses); before the first the body is taken to have been at rest."""
    before = jax.tree.map(lambda x: jnp.concatenate([x[:1], x[:-1]]), poses)
    return jax.vmap(features, in_axes=(0, 0, None))(before, poses, dt)


def windows(
    features: Float[np.ndarray, "f p"], first: Int[np.ndarray, " f"], count: int, stride: int
) -> Float[np.ndarray, "f w p"]:
    """The window of so many poses, `stride` frames apart and newest first, that ends in each of f frames of takes one
    after the other; before the first frame of a take, which is given for each, the body is taken to have stood still.
    """
    back = np.arange(len(features))[:, None] - stride * np.arange(count)
    return features[np.maximum(back, first[:, None])]
