"""What feet are meant to do: when the feet of a clip bear weight, and where they should be in the world."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from avatarjax import rotations
from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import footlock

_FPS = 30.0


@typing.no_type_check
@flax.struct.dataclass
class Feet:
    """The feet of a looping clip of n frames, left and right, relative to the figure's root, which faces +z.

    balls (n, 2, 3) the toes' joints, metres; turns (n, 2, 4) rotations of the feet from rest; toes (n, 2, 4) those of
    the toes against the feet; contacts (n, 2) whether the foot bears weight; until (n, 2) frames to its next contact.
    """

    balls: Float[Array, "n 2 3"]
    turns: Float[Array, "n 2 4"]
    toes: Float[Array, "n 2 4"]
    contacts: Bool[Array, "n 2"]
    until: Float[Array, "n 2"]


@typing.no_type_check
@flax.struct.dataclass
class Plan:
    """What the feet should do in f frames, in the world, left and right.

    balls, balls_before (f, 2, 3) where the toes' joints should be in this frame and, by the same mode of movement, one
    frame earlier, metres; turns, turns_before (f, 2, 4) likewise for the feet's rotations; toes (f, 2, 4) against the
    feet; contacts (f, 2) whether the foot should bear weight; until (f, 2) frames to its next contact; tolerance (f,)
    metres between a planted foot and its plan that call for a step, infinite where the plan does the stepping;
    pivot_lag (f,) radians by which a planted foot stays behind the turn of its plan before it pivots on the ball.
    """

    balls: Float[Array, "f 2 3"]
    balls_before: Float[Array, "f 2 3"]
    turns: Float[Array, "f 2 4"]
    turns_before: Float[Array, "f 2 4"]
    toes: Float[Array, "f 2 4"]
    contacts: Bool[Array, "f 2"]
    until: Float[Array, "f 2"]
    tolerance: Float[Array, " f"]
    pivot_lag: Float[Array, " f"]


def frames_until(contacts: Bool[np.ndarray, "n 2"], looping: bool = True) -> Float[np.ndarray, "n 2"]:
    """Frames from each frame to the next one with contact, 0 in contact; n where there is none."""
    n = len(contacts)
    ahead = np.concatenate([contacts, contacts if looping else np.zeros_like(contacts)])
    gaps = [np.where(ahead[i : i + n].any(0), ahead[i : i + n].argmax(0), n) for i in range(n)]
    return np.stack(gaps).astype(np.float32)


def clip_feet(
    rig: Rig,
    transforms: Float[Array, "n j 3 4"],
    quats: Float[Array, "n j 4"],
    speed: float = 0.0,
    looping: bool = True,
) -> Feet:
    """The feet of a clip of n frames that is meant to move along +z at `speed` metres a second.

    A foot comes into contact when it is both low and slow and leaves it when it is higher or faster by some margin:
    without hysteresis a foot that lands would come loose again.
    """
    bones = footlock.leg_bones(rig)
    soles, joints, turns = (np.asarray(x) for x in _points(rig, transforms))
    joints = joints[:, bones[:, 3]]
    lowest = soles[:, :, soles.shape[2] // 2 :, 1].min(axis=2)
    velocity = (np.roll(soles, -1, 0) - np.roll(soles, 1, 0)) * _FPS / 2
    if not looping:
        velocity[0], velocity[-1] = 0, 0
    pace = np.linalg.norm(velocity.mean(axis=2) + np.array([0, 0, speed]), axis=-1)
    slow = 0.3 + 0.3 * speed
    # Some clips stand a centimetre higher on one foot than on the other.
    lowest = lowest - np.clip(np.percentile(lowest, 10, axis=0), -0.02, 0.03)
    enter, leave = (lowest < 0.012) & (pace < slow), (lowest > 0.028) | (pace > 1.5 * slow)
    contacts = np.zeros(enter.shape, bool)
    state = enter[0]
    for _ in range(2):
        for i in range(len(enter)):
            state = np.where(state, ~leave[i], enter[i])
            contacts[i] = state
    return Feet(
        balls=jnp.asarray(joints),
        turns=jnp.asarray(turns[:, bones[:, 2]]),
        toes=quats[:, bones[:, 3]],
        contacts=jnp.asarray(contacts),
        until=jnp.asarray(frames_until(contacts, looping)),
    )


@jax.jit
def _points(rig: Rig, transforms: Array) -> tuple[Array, Array, Array]:
    soles = jax.vmap(skinning.sole_points, in_axes=(None, 0))(rig, transforms)
    joints = jax.vmap(skinning.joint_positions, in_axes=(None, 0))(rig, transforms)
    return soles, joints, rotations.from_matrix(transforms[..., :3])


def sample_feet(feet: Feet, phase: Float[Array, ""]) -> Feet:
    """The feet at a phase in cycles (any real number), with no frame axis; contacts are those of the frame before."""
    count = feet.balls.shape[0]
    position = (phase % 1.0) * count
    first = jnp.floor(position).astype(jnp.int32) % count
    weight = position - jnp.floor(position)
    second = (first + 1) % count
    mix = jnp.full(2, weight)
    return Feet(
        balls=feet.balls[first] * (1 - weight) + feet.balls[second] * weight,
        turns=rotations.nlerp(feet.turns[first], feet.turns[second], mix),
        toes=rotations.nlerp(feet.toes[first], feet.toes[second], mix),
        contacts=feet.contacts[first],
        until=jnp.maximum(feet.until[first] - weight, 0.0),
    )


def standing(rig: Rig, feet: Feet) -> Feet:
    """The feet of one frame (no frame axis) put flat on the ground where they are."""
    yaw = footlock.yaw_of(feet.turns)
    balls = feet.balls.at[:, 1].set(ball_heights(rig))
    still = jnp.zeros(2)
    toes = jnp.zeros((2, 4)).at[:, 0].set(1.0)
    return Feet(balls, level(yaw), toes, jnp.ones(2, bool), still)


def ball_heights(rig: Rig) -> Float[Array, " 2"]:
    """Height of the toes' joints, metres, of feet that stand flat."""
    soles = jnp.asarray(rig.soles)
    half = soles.shape[1] // 2
    return jnp.asarray(rig.heads)[footlock.leg_bones(rig)[:, 3], 1] - soles[:, half:, 1].min(axis=1)


def in_world(feet: Feet, roots: Float[Array, "f 2"], yaws: Float[Array, " f"]) -> Feet:
    """The feet of f frames, relative to roots on the ground (x, z) with yaws in radians, as feet in the world."""
    turn = jnp.repeat(about(1, yaws)[:, None], 2, axis=1)
    shift = jnp.stack([roots[:, 0], jnp.zeros(len(roots)), roots[:, 1]], axis=-1)
    return feet.replace(
        balls=footlock.rotate(turn, feet.balls) + shift[:, None], turns=rotations.multiply(turn, feet.turns)
    )


def plan(choices: typing.Any, tolerance: Float[Array, " f"], pivot_lag: Float[Array, " f"]) -> Plan:
    """One plan from feet in the world by mode: `choices` holds (mask (f,), feet, feet one frame earlier) by mode, the
    last that is true counts; `tolerance` and `pivot_lag` are the plan's."""
    _, now, before = choices[0]
    for mask, feet, feet_before in choices[1:]:

        def pick(a: Array, b: Array, mask: Array = mask) -> Array:
            return jnp.where(jnp.expand_dims(mask, tuple(range(1, a.ndim))), b, a)

        now, before = jax.tree.map(pick, now, feet), jax.tree.map(pick, before, feet_before)
    return Plan(
        balls=now.balls,
        balls_before=before.balls,
        turns=now.turns,
        turns_before=before.turns,
        toes=now.toes,
        contacts=now.contacts,
        until=now.until,
        tolerance=tolerance,
        pivot_lag=pivot_lag,
    )


def about(axis: int, angle: Float[Array, "*b"]) -> Float[Array, "*b 4"]:
    """Rotation by `angle`, radians, about the coordinate axis of that number."""
    half = angle / 2
    parts = [jnp.cos(half), *[jnp.sin(half) if k == axis else jnp.zeros_like(half) for k in range(3)]]
    return jnp.stack(parts, axis=-1)


def level(yaw: Float[Array, "*b"], rise: Float[Array, "*b"] | float = 0.0) -> Float[Array, "*b 4"]:
    """Rotation of a foot that points along `yaw`, with the heel raised by the angle `rise`, radians."""
    rise = jnp.broadcast_to(jnp.asarray(rise, yaw.dtype), yaw.shape)
    return rotations.multiply(about(1, yaw), about(0, rise))
