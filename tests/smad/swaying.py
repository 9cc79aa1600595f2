"""A doll of Gaussians whose lower half sways as it turns before a still camera: its takes, and where it truly was."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import cameras, rotations, splat
from avatarjax.data.recording import MonocularVideo, Poses, solid
from avatarjax.gaussians import Gaussians
from avatarjax.smad import driving, skeletal
from avatarjax.smad.driving import Pose

RADII = np.array([0.3, 0.6, 0.2])
PLACE = np.array([0.2, 1.0, -0.1], np.float32)  # Of the root in the world.
JOINTS = np.array([[0, 0, 0], [0, 0.5, 0], [0, -0.1, 0], [0, -0.6, 0]], np.float32)
PARENTS = (-1, 0, 0, 2)
CONFIG = splat.SplatConfig(depth=False)


def doll(count=300, seed=0):
    """Gaussians all over an ellipsoid about the root, in gay colours."""
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    unit = np.stack([np.cos(around) * np.sin(polar), np.cos(polar), np.sin(around) * np.sin(polar)], 1)
    colors = 0.5 + 0.4 * np.sin(unit * np.array([3.0, 7.0, 4.0]) + np.array([0.0, 1.0, 2.0]))
    return Gaussians(
        jnp.asarray(unit * RADII, jnp.float32),
        jnp.full((count, 3), np.log(0.035), jnp.float32),
        jnp.zeros((count, 4)).at[:, 0].set(1.0),
        jnp.full((count,), 2.0),
        jnp.asarray(colors, jnp.float32),
    )


def sway(points, frame, size=0.25, period=15.0):
    """Points of the doll at rest, in the body frame of a frame."""
    hang = jnp.clip(0.2 - points[:, 1], 0.0, None) / 0.8
    swing = jnp.sin(2 * jnp.pi * frame / period - 2 * hang)
    return points.at[:, 0].add(size * hang * swing)


def poses(frames, bend=0.0, skeleton=True):
    """A full turn; the lower half bends sideways by up to so many radians, which is told to whoever has a skeleton."""
    angles = 2 * np.pi * np.arange(frames) / frames
    turns = np.asarray(rotations.yaw_matrix(jnp.asarray(angles, jnp.float32)))
    bends = jnp.asarray(bend * np.sin(3 * angles), jnp.float32)[:, None] * jnp.array([[0.0, 0.0, 1.0]])
    local = np.tile(np.eye(3, dtype=np.float32), (frames, len(JOINTS), 1, 1))
    local[:, 2] = np.asarray(rotations.to_matrix(rotations.from_axis_angle(bends)))
    known = {"parents": PARENTS, "joints": JOINTS} if skeleton else {}
    return Poses(local, turns, np.tile(PLACE, (frames, 1)), **known)


def pose(poses, frame):
    return Pose(*(jnp.asarray(x[frame]) for x in (poses.rotations, poses.root_rotation, poses.root_translation)))


def take(frames=30, size=48, bend=0.0, skeleton=True, period=15.0, cloud=None):
    """A video, and the true tracks (f, n, 3) in the body frame. What bends, bends with the nearest bones."""
    cloud = doll() if cloud is None else cloud
    camera = cameras.look_at((0.5, 1.3, 3.2), PLACE, width=size, height=size, fov_y=0.42)
    told = poses(frames, bend, skeleton=True)
    skin = skeletal.bind(skeletal.rig_of(told), pose(told, 0), cloud.means)

    @jax.jit
    def shot(pose, frame):
        here = sway(skeletal.pose_points(skin, pose), frame, period=period)
        out = splat.render(cloud.replace(means=driving.to_world(pose, here)), camera, config=CONFIG)
        # Hard edges: a doll with a fringe would not be told apart from its wall by any mask.
        opaque = out.image / jnp.maximum(out.alpha, 0.5)[..., None]
        return here, jnp.where(out.alpha[..., None] > 0.5, opaque, 0.9), out.alpha

    tracks, images, masks = [], [], []
    for k in range(frames):
        here, image, alpha = shot(pose(told, k), float(k))
        tracks.append(np.asarray(here))
        images.append(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
        masks.append(np.asarray(alpha) > 0.5)
    shown = poses(frames, bend, skeleton)
    video = MonocularVideo(Path("."), solid(np.stack(masks)), camera, shown, 30.0, lambda: iter(images))
    return video, np.stack(tracks)
