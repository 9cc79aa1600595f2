"""Where feet stand: a causal pass over planned feet that pins each one while it bears weight and steps when it must.

A foot on the ground stays where it landed; in the air it follows the plan plus an offset that is gone by the next
landing, by a cubic that keeps place and velocity (the end-effector form of inertialisation). A planted foot too far
from its plan takes a step of its own, one foot at a time. A leg that gets short first raises its heel, then lowers the
hips, and then lets go. Kovar et al. 2002 ("Footskate cleanup for motion capture editing") do the same with hindsight;
here the frames before a key press do not depend on it.
"""

from __future__ import annotations

import functools
import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import footlock
from avatarjax.data.motion.foot_plans import Plan, about, ball_heights, level
from avatarjax.physics import springs

_FPS = 30.0
# Frames in which a foot in the air comes down when it shall stand, and those of a step from stand to stand.
_LAND_FRAMES = 6.0
_STEP_FRAMES = 8.0
# Frames in which the foot's angles change between those of the plan and those of standing.
_LEVEL_FRAMES = 3.0
_HEEL_RISE = 1.2
_DROP_LIMIT = 0.12
_DROP_FREQUENCY = 22.0
_FLAT_DROP = 0.035
_REACH = 0.98
_SWING_REACH = 0.995
# How far from under its hip, metres, a foot that steps by itself comes down.
_LONGEST_STEP = 0.36
# How high a swinging foot is at least: metres for each frame since it left the ground, and at most.
_CLEARANCE = (0.018, 0.05)
_OFFSET_PER_FRAME = 0.05
_NEAR_GROUND = 0.012


@typing.no_type_check
@flax.struct.dataclass
class _State:
    """What one frame hands to the next; velocities are per frame, `clock` counts a step's frames down, `standing` is
    the weight of the standing foot's angles."""

    ball: Array
    velocity: Array
    rate: Array
    tolerance: Array
    turn: Array
    spin: Array
    toes: Array
    planted: Array
    armed: Array
    pinned_yaw: Array
    rise: Array
    standing: Array
    clock: Array
    apex: Array
    aloft: Array
    short: Array
    drop: Array
    drop_rate: Array


def _rise_of(turn: Array) -> Array:
    """How far the heel is up, radians, of a foot's rotation; negative where the toes are."""
    yaw = footlock.yaw_of(turn)
    flat = rotations.multiply(about(1, -yaw), turn)
    return 2 * jnp.arctan2(flat[..., 1], flat[..., 0])


def _wrap(angle: Array) -> Array:
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def _conjugate(q: Array) -> Array:
    return q * jnp.array([[1.0, -1.0, -1.0, -1.0]], q.dtype)


def _cubic(offset: Array, rate: Array, frames: Array) -> tuple[Array, Array]:
    """One frame along the cubic that brings an offset and its rate to zero in `frames` frames (at least one)."""
    t = jnp.maximum(frames, 1.0)
    bend = -(3 * offset + 2 * rate * t) / t**2
    curl = (2 * offset + rate * t) / t**3
    return offset + rate + bend + curl, rate + 2 * bend + 3 * curl


def _stand(state: _State, turns: Array, rise: Array, weight: Array) -> Array:
    """Rotation of the feet between the planned one and that of standing at the pinned yaw."""
    smooth = weight * weight * (3 - 2 * weight)
    return rotations.nlerp(turns, level(state.pinned_yaw, rise), smooth)


def _sinking(rig: Rig, plan: Plan, ball: Array, yaw: Array, planted: Array, thighs: Array) -> Array:
    """By how much the hips should sink: where a planted leg is too short with the heel up, and a little where a
    standing figure would have to lift its heels."""
    heads = jnp.asarray(rig.heads)[footlock.leg_bones(rig)]
    reach = footlock.leg_lengths(rig) * _REACH
    aside = jnp.sum((thighs - ball)[:, ::2] ** 2, axis=-1)
    highest = jnp.sqrt(jnp.maximum((reach + 0.1) ** 2 - aside, 0.01)) + ball[:, 1] + 0.03
    ankle = ball + footlock.rotate(level(yaw), heads[:, 2] - heads[:, 3])
    aside = jnp.sum((thighs - ankle)[:, ::2] ** 2, axis=-1)
    flat = thighs[:, 1] - jnp.sqrt(jnp.maximum((reach - 0.003) ** 2 - aside, 0.01)) - ankle[:, 1]
    flat = jnp.where(jnp.isinf(plan.tolerance), 0.0, jnp.clip(flat, 0.0, _FLAT_DROP))
    need = jnp.clip(jnp.maximum(thighs[:, 1] - highest, flat), 0.0, _DROP_LIMIT)
    return jnp.max(jnp.where(planted, need, 0.0))


def _step(rig: Rig, state: _State, plan: Plan, thighs: Array) -> tuple[_State, tuple[Array, Array, Array, Array]]:
    """One frame: `plan` without its frame axis, thighs (2, 3) the places of the hip joints before the hips sink."""
    bones = footlock.leg_bones(rig)
    heads = jnp.asarray(rig.heads)[bones]
    soles = jnp.asarray(rig.soles) - heads[:, 3][:, None]
    half = soles.shape[1] // 2
    ground = ball_heights(rig)
    to_ankle = heads[:, 2] - heads[:, 3]
    reach = footlock.leg_lengths(rig) * _REACH
    patient = jnp.isinf(plan.tolerance)

    # A planted foot: leave with the plan, on a step of its own, or where the leg is too short.
    miss = jnp.linalg.norm((plan.balls - state.ball)[:, ::2], axis=-1)
    turned = jnp.abs(_wrap(footlock.yaw_of(plan.turns) - state.pinned_yaw))
    error = jnp.where(state.planted, miss / jnp.where(patient, 1.0, plan.tolerance) + turned / 0.5, 0.0)
    other = state.planted[::-1] & plan.contacts[::-1]
    first = jnp.array([True, False])
    worse = jnp.where(first, error >= error[::-1], error > error[::-1])
    own_step = ~patient & plan.contacts & state.planted & other & (error > 1) & worse
    short = state.planted & state.short
    leaving = state.planted & (~plan.contacts | own_step | short)
    own_step = own_step | (short & ~patient)
    planted = state.planted & ~leaving
    armed = (state.armed | ~plan.contacts) & ~(short & patient)

    # A foot in the air that shall stand without a landing in the plan gets a clock of its own.
    high = (state.ball[:, 1] - ground > _NEAR_GROUND) | (miss > 0.03)
    fall = ~patient & plan.contacts & ~state.planted & (state.clock <= 0) & high
    clock = jnp.where(own_step, _STEP_FRAMES, jnp.where(fall, _LAND_FRAMES, state.clock))
    clocked = plan.contacts & ~patient & ~planted & (clock > 0)
    clock = jnp.where(clocked, clock - 1, 0.0)
    apex = jnp.where(own_step, jnp.clip(0.3 * miss, 0.035, 0.1), jnp.where(fall, 0.0, state.apex))
    rising = (clock >= _STEP_FRAMES / 2) & (apex > 0)

    # In the air: the plan, plus an offset that is gone by the landing.
    lift = jnp.where(rising, apex, 0.0)
    velocity = plan.balls - plan.balls_before
    # A step of its own lands where the leg reaches, not where the figure will have come to rest.
    away = (plan.balls - thighs) * jnp.array([[1.0, 0.0, 1.0]])
    far = jnp.linalg.norm(away, axis=-1)
    over = jnp.where(patient, 0.0, jnp.maximum(far - _LONGEST_STEP, 0.0)) / jnp.maximum(far, _LONGEST_STEP)
    goal = (plan.balls - away * over[:, None]).at[:, 1].add(lift)
    # A small offset goes quickly, so that the leg does not trail behind a run; a large one has time.
    offset = state.ball - (goal - velocity)
    patience = 3 + jnp.linalg.norm(offset, axis=-1) / _OFFSET_PER_FRAME
    frames = jnp.where(clocked, clock + 1, jnp.clip(jnp.minimum(plan.until + 1, patience), 2.0, 9.0))
    frames_up = jnp.where(rising, clock + 1 - _STEP_FRAMES / 2 + 0.5, frames)
    remaining = jnp.stack([frames, frames_up, frames], axis=-1)
    # The offset has a velocity of its own, so that it does not lag behind a plan that speeds up.
    fresh = state.planted | (plan.tolerance != state.tolerance)
    rate = jnp.where(fresh[:, None], state.velocity - velocity, state.rate)
    offset, rate = _cubic(offset, rate, remaining)
    airborne, air_velocity = goal + offset, velocity + rate

    # Landing: the foot is pinned where it comes down.
    down = airborne[:, 1] - ground < _NEAR_GROUND
    landing = ~planted & ~leaving & plan.contacts & armed & (clock <= 0) & (down | clocked)
    yaw = footlock.yaw_of(state.turn)
    pinned_yaw = jnp.where(state.planted, state.pinned_yaw, yaw)
    planted = planted | landing
    lag = _wrap(footlock.yaw_of(plan.turns) - pinned_yaw)
    pinned_yaw = pinned_yaw + jnp.where(planted, lag - jnp.clip(lag, -plan.pivot_lag, plan.pivot_lag), 0.0)
    pinned = jnp.where(state.planted[:, None], state.ball, airborne)
    ball = jnp.where(planted[:, None], pinned, airborne)
    ball = ball.at[:, 1].set(jnp.where(planted, ground, ball[:, 1]))
    moving = jnp.where(planted[:, None], 0.0, air_velocity)

    need = _sinking(rig, plan, ball, pinned_yaw, planted, thighs)
    drop, drop_rate = springs.critical_step(state.drop, state.drop_rate, need, frequency=_DROP_FREQUENCY, dt=1 / _FPS)
    # The heel rises with the plan, and further until the ankle is in reach.
    rises = jnp.linspace(0.0, _HEEL_RISE, 13)
    tried = level(jnp.repeat(pinned_yaw[:, None], 13, axis=1), jnp.repeat(rises[None], 2, axis=0))
    ankles = footlock.rotate(tried, jnp.repeat(to_ankle[:, None], 13, axis=1))
    hips = thighs - jnp.stack([jnp.zeros(()), drop, jnp.zeros(())])[None]
    excess = jnp.linalg.norm(ball[:, None] + ankles - hips[:, None], axis=-1) - reach[:, None]
    ok = excess <= 0
    index = jnp.where(ok.any(axis=1), jnp.argmax(ok, axis=1), 12)
    before = jnp.maximum(index - 1, 0)
    e0 = jnp.take_along_axis(excess, before[:, None], axis=1)[:, 0]
    e1 = jnp.take_along_axis(excess, index[:, None], axis=1)[:, 0]
    part = jnp.where(index > before, jnp.clip(e0 / jnp.where(e0 - e1 > 1e-6, e0 - e1, 1.0), 0.0, 1.0), 0.0)
    needed = (before + part) * rises[1]
    planned = jnp.clip(_rise_of(plan.turns), 0.0, _HEEL_RISE - 0.1)
    rise = jnp.where(planted, jnp.maximum(planned, needed), state.rise)
    # Raising the heel takes a few frames, also where it is needed at once.
    rise = jnp.where(planted, jnp.clip(rise, state.rise - 0.3, state.rise + 0.35), rise * 0.8)

    standing = jnp.clip(state.standing + jnp.where(planted, 1.0, -1.0) / _LEVEL_FRAMES, 0.0, 1.0)
    state = state.replace(pinned_yaw=pinned_yaw)
    wanted = _stand(state, plan.turns, rise, standing)
    wanted_before = _stand(state, plan.turns_before, state.rise, state.standing)
    apart = rotations.to_axis_angle(rotations.multiply(state.turn, _conjugate(wanted_before)))
    own = rotations.to_axis_angle(rotations.multiply(wanted, _conjugate(wanted_before)))
    apart, spin = _cubic(apart, jnp.clip(state.spin - own, -0.5, 0.5), jnp.full((2, 1), 5.0))
    turn = rotations.multiply(rotations.from_axis_angle(apart), wanted)

    # A leg that trails behind in the air is drawn in before its knee locks.
    reaching = ball + footlock.rotate(turn, to_ankle) - hips
    length = jnp.linalg.norm(reaching, axis=-1)
    short_of = length - footlock.soft_length(length, reach * _SWING_REACH, 0.95)
    drawn = ball - reaching * (short_of / length)[:, None]
    ball = jnp.where(planted[:, None], ball, drawn)

    # Toes lie flat under a standing foot; no point of the sole goes under the ground.
    flat = rotations.multiply(_conjugate(turn), level(footlock.yaw_of(turn)))
    smooth = standing * standing * (3 - 2 * standing)
    toes = rotations.nlerp(plan.toes, flat, smooth)
    toes = rotations.nlerp(state.toes, toes, 0.5 + 0.5 * smooth)
    chain = jnp.stack([turn, rotations.multiply(turn, toes)], axis=1)
    lowest = footlock.rotate(jnp.repeat(chain, half, axis=1), soles)[..., 1].min(axis=1)
    aloft = jnp.where(planted, 0.0, state.aloft + 1)
    highest = jnp.where(clocked, jnp.maximum(apex, 0.03), _CLEARANCE[1])
    clear = jnp.minimum(jnp.minimum(_CLEARANCE[0] * aloft, highest), 0.02 * jnp.where(clocked, clock, plan.until))
    height = jnp.where(planted, -lowest, jnp.maximum(ball[:, 1], clear - lowest))
    ball = ball.at[:, 1].set(height)
    state = _State(
        ball=ball,
        velocity=moving,
        rate=rate,
        tolerance=plan.tolerance,
        turn=turn,
        spin=own + spin,
        toes=toes,
        planted=planted,
        armed=armed,
        pinned_yaw=pinned_yaw,
        rise=rise,
        standing=standing,
        clock=clock,
        apex=apex,
        aloft=aloft,
        short=~ok.any(axis=1),
        drop=drop,
        drop_rate=drop_rate,
    )
    return state, (ball, turn, toes, drop)


def step_feet(
    rig: Rig, plan: Plan, thighs: Float[Array, "f 2 3"]
) -> tuple[Float[Array, "f 2 3"], Float[Array, "f 2 4"], Float[Array, "f 2 4"], Float[Array, " f"]]:
    """Follow a plan with feet that do not slide.

    `thighs` (f, 2, 3) are the places of the hip joints, metres. Returns the toes' joints (f, 2, 3), the feet's
    rotations (f, 2, 4), the toes' against the feet (f, 2, 4), and by how much the hips sink (f,), metres.
    """
    first = jax.tree.map(lambda x: x[0], plan)
    zero, yaw = jnp.zeros(2), footlock.yaw_of(first.turns)
    state = _State(
        ball=first.balls_before,
        velocity=first.balls - first.balls_before,
        rate=jnp.zeros((2, 3)),
        tolerance=first.tolerance,
        turn=first.turns_before,
        spin=jnp.zeros((2, 3)),
        toes=first.toes,
        planted=first.contacts,
        armed=jnp.ones(2, bool),
        pinned_yaw=yaw,
        rise=jnp.clip(_rise_of(first.turns), 0.0, _HEEL_RISE - 0.1),
        standing=first.contacts.astype(jnp.float32),
        clock=zero,
        apex=zero,
        aloft=zero,
        short=jnp.zeros(2, bool),
        drop=_sinking(rig, first, first.balls_before, yaw, first.contacts, thighs[0]),
        drop_rate=jnp.zeros(()),
    )
    _, outputs = jax.lax.scan(lambda s, x: _step(rig, s, *x), state, (plan, thighs))
    return outputs


@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0, 0))
def _place(rig: Rig, quats: Array, hips: Array, balls: Array, turns: Array, toes: Array) -> tuple[Array, Array]:
    return footlock.place_feet(rig, quats, hips, balls, turns, toes)


@jax.jit
def lock_feet(
    rig: Rig, local_quats: Float[Array, "f j 4"], hips: Float[Array, "f 3"], plan: Plan
) -> tuple[Float[Array, "f j 4"], Float[Array, "f 3"], Float[Array, "f j 3 4"]]:
    """A motion of f frames with its feet on the plan: local rotations, hips (f, 3) in metres, and transforms."""
    transforms = jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0))(rig, local_quats, hips)
    bones = footlock.leg_bones(rig)[:, 0]
    moves = transforms[:, bones]
    thighs = jnp.sum(moves[..., :3] * jnp.asarray(rig.heads)[bones][None, :, None], axis=-1) + moves[..., 3]
    balls, turns, toes, drop = step_feet(rig, plan, thighs)
    hips = hips.at[:, 1].add(-drop)
    local_quats, transforms = _place(rig, local_quats, hips, balls, turns, toes)
    return local_quats, hips, transforms
