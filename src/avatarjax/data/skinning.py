"""Forward kinematics and linear blend skinning as pure functions of one frame; `jax.vmap` makes them sequences."""

from __future__ import annotations

import typing

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.data.body import Rig


def forward_kinematics(rig: Rig, local_quats: Float[Array, "j 4"], hips: Float[Array, " 3"]) -> Float[Array, "j 3 4"]:
    """Transforms (j, 3, 4) that carry points from the rest pose to the posed world, one a bone.

    `local_quats` (j, 4) turn each bone against its parent, the identity being the rest pose; `hips` (3,) is the world
    position of the hips joint, metres.
    """
    return pose_bones(rig, rotations.to_matrix(local_quats), hips)


def pose_bones(rig: Rig, turns: Float[Array, "j 3 3"], hips: Float[Array, " 3"]) -> Float[Array, "j 3 4"]:
    """`forward_kinematics` of rotation matrices (j, 3, 3).

    Every bone's transform is first that against its parent, then, by pointer doubling, against its ancestor two, four,
    eight... bones above: a chain of 11 takes four products of all bones at once.
    """
    heads, above = jnp.asarray(rig.heads), np.array(rig.parents)
    to = jnp.where((above < 0)[:, None], hips, heads)
    shift = to - jnp.einsum("jab,jb->ja", turns, heads)
    while (below := above >= 0).any():
        up = np.where(below, above, 0)
        # Sums, not a batched product of 3x3 matrices: XLA's CPU compiler fails on that one under vmap in a scan.
        turned = jnp.sum(turns[up][..., None] * turns[:, None], axis=2)
        moved = shift[up] + jnp.sum(turns[up] * shift[:, None], axis=2)
        turns = jnp.where(below[:, None, None], turned, turns)
        shift = jnp.where(below[:, None], moved, shift)
        above = np.where(below, above[up], -1)
    return jnp.concatenate([turns, shift[..., None]], axis=-1)


def skinning_basis(
    vertices: Float[Array, "v 3"], weights: Float[Array, "v j"], *, direction: bool = False
) -> Float[Array, "k v"]:
    """The matrix (4 j, v) of weighted homogeneous rest positions, with which skinning is one matrix product.

    With `direction` the vectors are turned by the bones but not moved, as normals are.

    Dense beats sparse here: 2,000 frames are one product of (6000, 4 j) with (4 j, v), and a gather of four bones a
    vertex moves more memory.
    """
    homogeneous = jnp.concatenate([vertices, jnp.full((len(vertices), 1), 0.0 if direction else 1.0)], axis=1)
    return jnp.einsum("vj,vk->jkv", weights, homogeneous).reshape(-1, len(vertices))


def skin(basis: Float[Array, "k v"], transforms: Float[Array, "j 3 4"]) -> Float[Array, "v 3"]:
    """Linear blend skinning: posed vertices (v, 3) from a `skinning_basis` (4 j, v) and bone transforms (j, 3, 4)."""
    return (jnp.moveaxis(transforms, 1, 0).reshape(3, -1) @ basis).T


def joint_positions(rig: Rig, transforms: Float[Array, "j 3 4"]) -> Float[Array, "j 3"]:
    """World positions (j, 3) of the bones' heads."""
    return jnp.einsum("jab,jb->ja", transforms[..., :3], jnp.asarray(rig.heads)) + transforms[..., 3]


def sole_points(rig: Rig, transforms: Float[Array, "j 3 4"]) -> Float[Array, "2 s 3"]:
    """World positions (2, s, 3) of the points under the left and the right foot."""
    soles = jnp.asarray(rig.soles)
    half = soles.shape[1] // 2
    bones = [
        [rig.index(side + bone) for bone in ("Foot", "ToeBase") for _ in range(half)] for side in ("Left", "Right")
    ]
    moves = transforms[np.array(bones)]
    return jnp.einsum("fsab,fsb->fsa", moves[..., :3], soles) + moves[..., 3]


@jax.jit
def joint_paths(
    rig: Rig, local_quats: Float[Array | np.ndarray, "f j 4"], hips: Float[Array | np.ndarray, "f 3"]
) -> Float[Array, "f j 3"]:
    """World positions (f, j, 3) of the joints of a recorded motion, such as a `Take`'s quats and hips, metres."""
    transforms = jax.vmap(forward_kinematics, in_axes=(None, 0, 0))(rig, jnp.asarray(local_quats), jnp.asarray(hips))
    return jax.vmap(joint_positions, in_axes=(None, 0))(rig, transforms)


class Feet(typing.NamedTuple):
    """Both feet, left and right, of f frames in the world, metres: points under them (f, 2, s, 3), of which the second
    half are under the toes, and the balls (f, 2, 3), the joints at the base of the toes."""

    soles: Float[np.ndarray, "f 2 s 3"]
    balls: Float[np.ndarray, "f 2 3"]

    @property
    def toes(self) -> Float[np.ndarray, "f 2 p 3"]:
        """The points under the toes."""
        return self.soles[:, :, self.soles.shape[2] // 2 :]


def feet(rig: Rig, transforms: Float[Array | np.ndarray, "f j 3 4"]) -> Feet:
    """Where the feet are in a motion of bone transforms: what foot slide is measured on (`metrics.foot_slide`)."""
    soles, joints = _feet(rig, jnp.asarray(transforms))
    return Feet(np.asarray(soles), np.asarray(joints)[:, [rig.index(s + "ToeBase") for s in ("Left", "Right")]])


@jax.jit
def _feet(rig: Rig, transforms: Array) -> tuple[Array, Array]:
    soles = jax.vmap(sole_points, in_axes=(None, 0))(rig, transforms)
    return soles, jax.vmap(joint_positions, in_axes=(None, 0))(rig, transforms)
