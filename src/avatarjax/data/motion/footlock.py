"""Legs that reach for given feet: two-bone inverse kinematics from hip to ankle, in closed form and differentiable.

The leg keeps the bending plane of the pose it starts from, carried along by the shortest arc from the old ankle
direction to the new one. A target beyond the leg's length is approached, never reached: no knee snaps straight.
"""

from __future__ import annotations

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.data import skinning
from avatarjax.data.body import Rig

SIDES = ("Left", "Right")
# Share of the leg's length up to which a target is met exactly; the rest is for the soft approach.
EXACT_REACH = 0.985
# How much the hinge of the rest pose counts against the plane of a bent knee, which a straight leg does not have.
_HINGE_SHARE = 0.15
_TINY = 1e-9


def _unit(v: Array) -> Array:
    return v * jax.lax.rsqrt(jnp.sum(v * v, axis=-1, keepdims=True) + _TINY)


def _reject(v: Array, axis: Array) -> Array:
    """What of v is square to the unit vector `axis`, as a unit vector."""
    return _unit(v - axis * jnp.sum(v * axis, axis=-1, keepdims=True))


def rotate(q: Float[Array, "*b 4"], v: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Vectors turned by unit quaternions; cheaper to compile than matrices."""
    w, u = q[..., :1], q[..., 1:]
    t = 2 * jnp.cross(u, v)
    return v + w * t + jnp.cross(u, t)


def _arc(a: Array, b: Array) -> Array:
    """The quaternion of least angle that takes unit vector a to b; finite, if arbitrary, where they are opposite."""
    w = 1 + jnp.sum(a * b, axis=-1, keepdims=True)
    return rotations.normalize(jnp.concatenate([w + 1e-6, jnp.cross(a, b)], axis=-1))


def _frame(direction: Array, normal: Array) -> Array:
    """Rotation matrix with columns direction, normal made square to it, and their product."""
    normal = _reject(normal, direction)
    return jnp.stack([direction, normal, jnp.cross(direction, normal)], axis=-1)


def _product(a: Array, b: Array) -> Array:
    # Sums, not batched products of 3x3 matrices: XLA's CPU compiler fails on those under vmap in a scan.
    return jnp.sum(a[..., :, :, None] * b[..., None, :, :], axis=-2)


def soft_length(
    distance: Float[Array, "*b"], longest: Float[Array, "*b"], share: float = EXACT_REACH
) -> Float[Array, "*b"]:
    """`distance` where it is under `share` of `longest`; from there on it nears `longest` without passing it."""
    start = share * longest
    room = longest - start
    beyond = jnp.maximum(distance - start, 0)
    return jnp.minimum(distance, start) + room * (1 - jnp.exp(-beyond / room)) * (1 - 1e-4)


def two_bone(
    hip: Float[Array, "*b 3"],
    knee: Float[Array, "*b 3"],
    ankle: Float[Array, "*b 3"],
    hinge: Float[Array, "*b 3"],
    target: Float[Array, "*b 3"],
    swivel: Float[Array, "*b"] | float = 0.0,
) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3 3"]]:
    """World rotations (*b, 3, 3) to put on top of thigh and shank so that the ankle comes to `target`.

    hip, knee, ankle and target (*b, 3) are places in the world, metres; `hinge` (*b, 3) is the unit axis about which
    the knee bends, which decides where the leg is nearly straight. `swivel` turns the knee about the line from hip to
    target, radians. Bone lengths stay; beyond the leg's reach the ankle stops on the way to the target (`soft_length`).
    """
    thigh, shank = knee - hip, ankle - knee
    upper, lower = jnp.linalg.norm(thigh, axis=-1), jnp.linalg.norm(shank, axis=-1)
    thigh, shank = thigh / upper[..., None], shank / lower[..., None]
    normal = _unit(jnp.cross(thigh, shank) + _HINGE_SHARE * hinge)
    before, wanted = _unit(ankle - hip), target - hip
    squared = jnp.sum(wanted * wanted, axis=-1)
    # A target in the hip joint itself has no direction: the leg folds along the old one.
    distance = jnp.sqrt(jnp.where(squared < 1e-6, 1e-6, squared))
    direction = jnp.where((squared < 1e-6)[..., None], before, wanted / distance[..., None])
    reach = jnp.maximum(soft_length(distance, upper + lower), jnp.abs(upper - lower) + 0.02)

    swivel = jnp.broadcast_to(jnp.asarray(swivel, direction.dtype), distance.shape)
    turn = rotations.multiply(rotations.from_axis_angle(direction * swivel[..., None]), _arc(before, direction))
    bent = _reject(rotate(turn, _reject(normal, before)), direction)
    pole = jnp.cross(direction, bent)
    along = (upper**2 - lower**2 + reach**2) / (2 * reach)
    aside = jnp.sqrt(jnp.maximum(upper**2 - along**2, 1e-8))
    new_thigh = _unit(direction * along[..., None] + pole * aside[..., None])
    new_shank = _unit(direction * (reach - along)[..., None] - pole * aside[..., None])
    return (
        _product(_frame(new_thigh, bent), jnp.swapaxes(_frame(thigh, normal), -1, -2)),
        _product(_frame(new_shank, bent), jnp.swapaxes(_frame(shank, normal), -1, -2)),
    )


@functools.lru_cache
def _leg_bones(names: tuple[str, ...]) -> np.ndarray:
    return np.array([[names.index(s + b) for b in ("UpLeg", "Leg", "Foot", "ToeBase")] for s in SIDES])


def leg_bones(rig: Rig) -> np.ndarray:
    """Joint numbers (2, 4) of thigh, shank, foot and toes, left and right."""
    return _leg_bones(rig.names)


def leg_lengths(rig: Rig) -> Float[Array, " 2"]:
    """Thigh and shank together, metres, left and right."""
    heads = jnp.asarray(rig.heads)[leg_bones(rig)]
    return jnp.linalg.norm(heads[:, 1] - heads[:, 0], axis=-1) + jnp.linalg.norm(heads[:, 2] - heads[:, 1], axis=-1)


def yaw_of(q: Float[Array, "*b 4"]) -> Float[Array, "*b"]:
    """Yaw, radians, of where a bone's +z of the rest pose points; of its +y where it points up or down."""
    w, _, y, _ = jnp.moveaxis(rotations.normalize(q), -1, 0)
    # The swing-twist angle about y: unlike the heading of +z it does not flip when the foot points at the ground.
    return 2 * jnp.arctan2(y, jnp.where(jnp.abs(w) + jnp.abs(y) < 1e-6, 1.0, w))


def place_feet(
    rig: Rig,
    local_quats: Float[Array, "j 4"],
    hips: Float[Array, " 3"],
    balls: Float[Array, "2 3"],
    feet: Float[Array, "2 4"],
    toes: Float[Array, "2 4"],
) -> tuple[Float[Array, "j 4"], Float[Array, "j 3 4"]]:
    """A pose whose feet stand where they should: new local rotations (j, 4) and transforms (j, 3, 4) of the bones.

    `balls` (2, 3) are the wanted places of the toes' joint in the world, metres; `feet` (2, 4) the feet's rotations in
    the world and `toes` (2, 4) those of the toes against the feet, all from the rest pose. Hips and upper body stay.
    """
    bones = leg_bones(rig)
    heads = jnp.asarray(rig.heads)[bones]
    transforms = skinning.forward_kinematics(rig, local_quats, hips)
    turns = transforms[bones][..., :3]
    points = jnp.sum(turns * heads[:, :, None], axis=-1) + transforms[bones][..., 3]
    rest = jnp.cross(heads[:, 1] - heads[:, 0], heads[:, 2] - heads[:, 1])
    hinge = jnp.sum(turns[:, 0] * _unit(rest)[:, None], axis=-1)
    target = balls + rotate(feet, heads[:, 2] - heads[:, 3])
    # The knee follows the foot half of the way where the foot is turned away from the pose.
    twist = yaw_of(feet) - yaw_of(rotations.from_matrix(turns[:, 2]))
    twist = (twist + jnp.pi) % (2 * jnp.pi) - jnp.pi
    swivel = -0.5 * jnp.clip(twist, -1.2, 1.2) * jnp.cos(twist / 2)
    thigh, shank = two_bone(points[:, 0], points[:, 1], points[:, 2], hinge, target, swivel)
    thigh, shank = _product(thigh, turns[:, 0]), _product(shank, turns[:, 1])
    foot = rotations.to_matrix(feet)
    parents = transforms[np.array(rig.parents)[bones[:, 0]]][..., :3]
    chain = [parents, thigh, shank, foot]
    local = [rotations.from_matrix(_product(jnp.swapaxes(up, -1, -2), down)) for up, down in itertools.pairwise(chain)]
    local_quats = local_quats.at[bones].set(jnp.stack([*local, toes], axis=1))
    return local_quats, skinning.forward_kinematics(rig, local_quats, hips)
