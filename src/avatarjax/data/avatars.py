"""The avatars by name, and the poses that stand for them."""

from __future__ import annotations

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import clips
from avatarjax.data.wardrobe.assembly import AvatarMesh

NAMES = ("monk", "cowgirl", "survival", "berserker", "ghostlady")  # UNICA's five


def names() -> tuple[str, ...]:
    """The avatars that `build` knows."""
    return NAMES


@functools.cache
def build(name: str) -> AvatarMesh:
    """The avatar of that name, the same arrays every time: treat them as read-only. Raises ValueError for other
    names."""
    if name not in NAMES:
        raise ValueError(f"unknown avatar {name!r}; there are {', '.join(NAMES)}")
    return importlib.import_module(f"avatarjax.data.looks.{name}").look()


def rest_pose(rig: Rig) -> Float[Array, "j 3 4"]:
    """Bone transforms (j, 3, 4) of the pose in which the mesh was made."""
    return jnp.broadcast_to(jnp.eye(3, 4), (len(rig.names), 3, 4))


def a_pose(rig: Rig, degrees: float = 18.0) -> Float[Array, "j 3 4"]:
    """Bone transforms (j, 3, 4) of the reference pose of the position maps: standing, arms straight and lowered to
    `degrees` from the vertical, so that the figure is about twice as tall as it is wide."""
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(rig.names), 1))
    angle = np.deg2rad(degrees)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = rig.index(side + "Arm")
        along = rig.tails[arm] - rig.heads[arm]
        along = along / np.linalg.norm(along)
        wanted = np.array([sign * np.sin(angle), -np.cos(angle), 0.0])
        cross = np.cross(along, wanted)
        quat = np.array([1 + along @ wanted, *cross])
        quats[arm] = quat / np.linalg.norm(quat)
    return _on_the_ground(rig, jnp.asarray(quats), jnp.asarray(rig.heads[rig.index("Hips")]))


def standing_pose(rig: Rig) -> Float[Array, "j 3 4"]:
    """Bone transforms (j, 3, 4) of the first frame of standing idle, facing +z at the origin."""
    idle = clips.load_clip("idle", rig)
    return _on_the_ground(rig, idle.quats[0], idle.hips[0])


def _on_the_ground(rig: Rig, quats: Array, hips: Array) -> Array:
    transforms = jax.jit(skinning.forward_kinematics)(rig, quats, hips)
    lowest = skinning.sole_points(rig, transforms)[..., 1].min()
    return transforms.at[:, 1, 3].add(-lowest)
