"""Linear blend skinning of points that nobody has rigged: what every loose garment is compared with, and driven by.

Weights come from distances to the bones, as a template's do where its garments hang on the nearest limb. A skirt that
is skinned so follows the thighs at once and splits between them (SMAD 1, Fig. 1): secondary motion is what is missing.
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
from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.recording import Poses
from avatarjax.smad import driving
from avatarjax.smad.driving import Pose


@typing.no_type_check
@flax.struct.dataclass
class Skin:
    """n points bound to a skeleton: the rig, the pose in which they lie where they lie, and what carries them.

    basis (4 j, n) are their weighted homogeneous rest positions (`data.skinning.skinning_basis`).
    """

    rig: Rig
    basis: Float[Array, "k n"]


def rig_of(poses: Poses) -> Rig:
    """The skeleton of recorded poses; raises ValueError where they do not say where its joints are."""
    if poses.joints is None or poses.parents is None:
        raise ValueError("poses without joints and parents cannot skin anything: add both to poses.npz")
    heads = jnp.asarray(poses.joints)
    names = poses.names or tuple(str(j) for j in range(len(heads)))
    return Rig(heads, heads, jnp.zeros((2, 0, 3)), names, poses.parents)


def bones(rig: Rig, pose: Pose) -> Float[Array, "j 3 4"]:
    """What carries points of the rest pose, bone by bone, to the body frame of a pose."""
    tilt = rotations.yaw_matrix(driving.yaw(pose.root_rotation)).T @ pose.root_rotation
    turns = pose.rotations.at[0].set(tilt @ pose.rotations[0])
    return skinning.pose_bones(rig, turns, jnp.zeros(3))


@functools.partial(jax.jit, static_argnames="sharpness")
def bind(rig: Rig, pose: Pose, points: Float[Array, "n 3"], sharpness: float = 4.0) -> Skin:
    """Bind points that lie in the body frame of a pose, metres.

    A point's weight for a bone falls with the given power of its distance to it (Shepard's inverse distances); of a
    bone of fingers or toes that is nothing but its joint, with the distance to that.
    """
    now = bones(rig, pose)
    weights = inverse_distances(points, skinning.joint_positions(rig, now), np.array(rig.parents), sharpness)
    # Back to the rest pose by the inverse of the blended transform: skinning with the same pose then gives the points.
    blended = jnp.einsum("nj,jab->nab", weights, now)
    rest = jnp.linalg.solve(blended[..., :3], (points - blended[..., 3])[..., None])[..., 0]
    return Skin(rig, skinning.skinning_basis(rest, weights))


def inverse_distances(
    points: Float[Array, "n 3"], joints: Float[Array, "j 3"], parents: Int[np.ndarray, " j"], sharpness: float
) -> Float[Array, "n j"]:
    """Weights (n, j) by distances to bones, rows sum to 1. A joint's bone reaches to its children's joints."""
    children = np.flatnonzero(parents >= 0)
    above = parents[children]
    distances = jax.vmap(_distance, in_axes=(None, 0, 0))
    apart = distances(points, joints, joints).at[above].min(distances(points, joints[above], joints[children]))
    # A millimetre keeps a point on a bone from having an infinite weight.
    closeness = (jnp.min(apart, axis=0, keepdims=True) + 1e-3) / (apart + 1e-3)
    weights = closeness**sharpness
    return (weights / jnp.sum(weights, axis=0, keepdims=True)).T


def pose_points(skin: Skin, pose: Pose) -> Float[Array, "n 3"]:
    """The points in the body frame of another pose."""
    return skinning.skin(skin.basis, bones(skin.rig, pose))


def _distance(points: Float[Array, "n 3"], start: Float[Array, " 3"], end: Float[Array, " 3"]) -> Float[Array, " n"]:
    """From points to a line segment, which may be a point."""
    along = end - start
    share = jnp.clip((points - start[None]) @ along / jnp.maximum(along @ along, 1e-12), 0.0, 1.0)
    return jnp.linalg.norm(points - start[None] - share[:, None] * along[None], axis=-1)
