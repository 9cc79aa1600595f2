"""A monocular video as a camera that moves about a body which holds still.

In the body frame of `driving`, which is the canonical space of everything here, what follows the root does not move: a
person who turns before one camera is seen from all sides, as a statue would be.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax import rotations
from avatarjax.cameras import Camera
from avatarjax.data.recording import MonocularVideo
from avatarjax.smad import driving


@jax.jit
def body_cameras(camera: Camera, root_rotation: Float[Array, "f 3 3"], root_translation: Float[Array, "f 3"]) -> Camera:
    """The cameras (f,) of all frames in the body frame, from one camera of the world or a batch of f."""
    frames = len(root_rotation)
    body_to_world = jnp.zeros((frames, 4, 4)).at[:, 3, 3].set(1.0).at[:, :3, 3].set(root_translation)
    body_to_world = body_to_world.at[:, :3, :3].set(rotations.yaw_matrix(driving.yaw(root_rotation)))
    world_to_camera = jnp.broadcast_to(camera.world_to_camera, (frames, 4, 4))
    intrinsics = jnp.broadcast_to(camera.intrinsics, (frames, 3, 3))
    return camera.replace(world_to_camera=world_to_camera @ body_to_world, intrinsics=intrinsics)


def of_video(video: MonocularVideo, frames: Int[np.ndarray, " k"]) -> Camera:
    """The cameras (k,) of some frames of a video in the body frame."""
    camera = video.camera
    if camera.world_to_camera.ndim == 3:
        camera = camera.replace(world_to_camera=camera.world_to_camera[frames], intrinsics=camera.intrinsics[frames])
    rotation, translation = video.poses.root_rotation[frames], video.poses.root_translation[frames]
    return body_cameras(camera, rotation, translation)


def spread(frames: int, limit: int) -> Int[np.ndarray, " k"]:
    """At most `limit` of so many frames, as evenly as can be."""
    return np.unique(np.linspace(0, frames - 1, min(frames, limit)).round().astype(int))
