"""A monocular video as a camera that moves about a body which holds still.

Poses say how the body's frame, at the pelvis, lies in the world in every frame. In that frame, the canonical one, what
is rigid to the pelvis does not move: a person who turns before one camera is seen from all sides, as a statue would be.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.cameras import Camera
from avatarjax.data.importers.recording import MonocularVideo


def body_cameras(camera: Camera, root_rotation: Float[Array, "f 3 3"], root_translation: Float[Array, "f 3"]) -> Camera:
    """The cameras (f,) of all frames in the body's frame, from one camera of the world or a batch of f.

    A body point x lies at root_rotation @ x + root_translation, metres.
    """
    frames = len(root_rotation)
    body_to_world = jnp.zeros((frames, 4, 4)).at[:, 3, 3].set(1.0)
    body_to_world = body_to_world.at[:, :3, :3].set(root_rotation).at[:, :3, 3].set(root_translation)
    world_to_camera = jnp.broadcast_to(camera.world_to_camera, (frames, 4, 4))
    intrinsics = jnp.broadcast_to(camera.intrinsics, (frames, 3, 3))
    return camera.replace(world_to_camera=world_to_camera @ body_to_world, intrinsics=intrinsics)


def of_video(video: MonocularVideo, frames: Int[np.ndarray, " k"]) -> Camera:
    """The cameras (k,) of some frames of a video in the body's frame."""
    camera = video.camera
    if camera.world_to_camera.ndim == 3:
        camera = camera.replace(world_to_camera=camera.world_to_camera[frames], intrinsics=camera.intrinsics[frames])
    rotation, translation = video.poses.root_rotation[frames], video.poses.root_translation[frames]
    return body_cameras(camera, jnp.asarray(rotation), jnp.asarray(translation))


def spread(frames: int, limit: int) -> Int[np.ndarray, " k"]:
    """At most `limit` of so many frames, as evenly as can be."""
    return np.unique(np.linspace(0, frames - 1, min(frames, limit)).round().astype(int))
