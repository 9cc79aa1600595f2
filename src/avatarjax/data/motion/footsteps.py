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
import numpy as np
from jaxtyping import Array, Bool, Float

from avatarjax import rotations
from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import footlock
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
    soles = np.asarray(jax.vmap(lambda t: skinning.sole_points(rig, t))(transforms))
    joints = np.asarray(jax.vmap(lambda t: skinning.joint_positions(rig, t))(transforms))[:, bones[:, 3]]
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
        turns=rotations.from_matrix(transforms[:, bones[:, 2], :, :3]),
        toes=quats[:, bones[:, 3]],
        contacts=jnp.asarray(contacts),
        until=jnp.asarray(frames_until(contacts, looping)),
    )


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
    turn = jnp.repeat(_about(1, yaws)[:, None], 2, axis=1)
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


def _about(axis: int, angle: Array) -> Array:
    half = angle / 2
    parts = [jnp.cos(half), *[jnp.sin(half) if k == axis else jnp.zeros_like(half) for k in range(3)]]
    return jnp.stack(parts, axis=-1)


def level(yaw: Float[Array, "*b"], rise: Float[Array, "*b"] | float = 0.0) -> Float[Array, "*b 4"]:
    """Rotation of a foot that points along `yaw`, with the heel raised by the angle `rise`, radians."""
    rise = jnp.broadcast_to(jnp.asarray(rise, yaw.dtype), yaw.shape)
    return rotations.multiply(_about(1, yaw), _about(0, rise))


def _rise_of(turn: Array) -> Array:
    """How far the heel is up, radians, of a foot's rotation; negative where the toes are."""
    yaw = footlock.yaw_of(turn)
    flat = rotations.multiply(_about(1, -yaw), turn)
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


def _step(rig: Rig, state: _State, plan: Plan, thighs: Array) -> tuple[_State, tuple[Array, ...]]:
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

    # The hips sink, softly, where a planted leg is too short with the heel a little up.
    aside = jnp.sum((thighs - ball)[:, ::2] ** 2, axis=-1)
    highest = jnp.sqrt(jnp.maximum((reach + 0.1) ** 2 - aside, 0.01)) + ball[:, 1] + 0.03
    need = jnp.max(jnp.where(planted, thighs[:, 1] - highest, 0.0))
    drop, drop_rate = springs.critical_step(
        state.drop, state.drop_rate, jnp.clip(need, 0.0, _DROP_LIMIT), frequency=_DROP_FREQUENCY, dt=1 / _FPS
    )
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
    zero = jnp.zeros(2)
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
        pinned_yaw=footlock.yaw_of(first.turns),
        rise=jnp.clip(_rise_of(first.turns), 0.0, _HEEL_RISE - 0.1),
        standing=first.contacts.astype(jnp.float32),
        clock=zero,
        apex=zero,
        aloft=zero,
        short=jnp.zeros(2, bool),
        drop=jnp.zeros(()),
        drop_rate=jnp.zeros(()),
    )
    _, outputs = jax.lax.scan(lambda s, x: _step(rig, s, *x), state, (plan, thighs))
    return outputs


@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0, 0))
def _place(rig: Rig, quats: Array, hips: Array, balls: Array, turns: Array, toes: Array) -> tuple[Array, Array]:
    return footlock.place_feet(rig, quats, hips, balls, turns, toes)


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
