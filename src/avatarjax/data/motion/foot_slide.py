"""How far feet slide and how deep they sink, measured on the motion alone."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from avatarjax.data import skinning
from avatarjax.data.body import Rig

# A foot touches the ground while the lowest point under its toes is lower than this, metres.
CONTACT_HEIGHT = 0.015
_SIDES = ("Left", "Right")


def contacts(rig: Rig, transforms: Float[Array | np.ndarray, "f j 3 4"]) -> Bool[np.ndarray, "f 2"]:
    """Which foot, left and right, touches the ground in each frame: the lowest point under its toes is below
    CONTACT_HEIGHT."""
    points = _soles(rig, transforms)
    return points[:, :, points.shape[2] // 2 :, 1].min(axis=2) < CONTACT_HEIGHT


def foot_slide(rig: Rig, transforms: Float[Array | np.ndarray, "f j 3 4"]) -> Float[np.ndarray, " n"]:
    """Horizontal path length of the ball of the foot, metres, in each of the n contacts of a motion.

    A contact is a maximal run of at least two frames in which one foot's lowest point under the toes is within
    CONTACT_HEIGHT of the ground or below it. The ball of the foot is the joint at the base of the toes: it moves
    neither when the heel rises nor when the foot pivots on it, and a path length counts every to and fro. Nothing but
    the motion enters, in particular no flag of the foot lock; a swinging foot that brushes along the ground counts as
    a slide. Left contacts come first, each foot's in order of time.
    """
    touching = contacts(rig, transforms)
    joints = np.asarray(_points(rig, jnp.asarray(transforms))[1])
    slides = []
    for side, name in enumerate(_SIDES):
        ball = joints[:, rig.index(name + "ToeBase")][:, [0, 2]]
        steps = np.linalg.norm(np.diff(ball, axis=0), axis=1)
        edges = np.flatnonzero(np.diff(np.r_[False, touching[:, side], False]))
        slides += [steps[a : b - 1].sum() for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]
    return np.array(slides, np.float32)


def sinking(rig: Rig, transforms: Float[Array | np.ndarray, "f j 3 4"]) -> float:
    """The deepest that any sole point gets below the ground, metres, never negative."""
    return float(max(0.0, -_soles(rig, transforms)[..., 1].min()))


def _soles(rig: Rig, transforms: Array | np.ndarray) -> np.ndarray:
    return np.asarray(_points(rig, jnp.asarray(transforms))[0])


@jax.jit
def _points(rig: Rig, transforms: Array) -> tuple[Array, Array]:
    soles = jax.vmap(skinning.sole_points, in_axes=(None, 0))(rig, transforms)
    return soles, jax.vmap(skinning.joint_positions, in_axes=(None, 0))(rig, transforms)
