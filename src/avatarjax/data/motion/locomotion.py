"""A keyboard-driven runner: held keys in, poses of a skeleton at 30 frames a second out, as one jitted `lax.scan`.

The key sets the wanted direction of movement in the world. Springs act on the angle of the heading and on the scalar
speed, never on the velocity vector: the figure turns about, it does not slide through a standstill. Idle and run follow
each other by inertialisation (Bollo 2018, "Inertialization: high-performance animation transitions in Gears of War"):
at a switch the difference of pose and its velocity are kept and decay to nothing on top of the new clip. The feet
are planned apart from the pose (stride warping: steps are as long as the speed makes them), and `footsteps` pins them.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax import rotations
from avatarjax.data import skinning
from avatarjax.data.body import Rig
from avatarjax.data.motion import foot_plans, footsteps
from avatarjax.data.motion.clips import Clips, sample
from avatarjax.physics import springs


@dataclasses.dataclass(frozen=True)
class LocomotionConfig:
    """Constants of the runner. Angles in radians, frequencies in radians a second; action 0 is idle.

    `turn_frequency` is tuned to UNICA's turns: 12 frames for 180 degrees and 9 for 90 until the movement direction
    stays within 12 degrees of the new one. `foot_lock` pins the feet to the ground while they bear weight. `emotes`
    names the clips of the extra actions 5, 6, ...: played in place, over and over while the key is held; `Clips` must
    be loaded with the same names.
    """

    fps: float = 30.0
    directions: tuple[float, ...] = (0.0, math.pi, math.pi / 2, -math.pi / 2)
    turn_frequency: float = 10.7
    speed_frequency: float = 10.0
    turn_slowdown: float = 0.45
    blend_frequency: float = 13.0
    slowest_gait: float = 0.3
    lean_per_turn: float = 0.03
    lean_limit: float = 0.3
    pitch_per_acceleration: float = 0.016
    pitch_limit: float = 0.2
    lean_frequency: float = 14.0
    look_per_turn: float = 0.05
    look_limit: float = 0.5
    foot_lock: bool = True
    foot_lookahead: float = 0.05
    pivot_lag: float = 0.8
    step_tolerance: float = 0.05
    emote_tolerance: float = 0.14
    emote_speed: float = 0.4
    emotes: tuple[str, ...] = ()


def action_names(config: LocomotionConfig = LocomotionConfig()) -> tuple[str, ...]:
    """Names of the actions by id: UNICA's five, then the emotes of the configuration."""
    return ("idle", "forward", "backward", "left", "right", *config.emotes)


@typing.no_type_check
@flax.struct.dataclass
class Motion:
    """f frames of a moving skeleton with j bones, in the world, metres.

    local_quats (f, j, 4); hips (f, 3) the hips joint; transforms (f, j, 3, 4) from the rest pose to the world; roots
    (f, 3) the point of the ground under the figure; headings (f,) yaw, radians, not wrapped; speeds (f,) metres a
    second along the heading.
    """

    local_quats: Float[Array, "f j 4"]
    hips: Float[Array, "f 3"]
    transforms: Float[Array, "f j 3 4"]
    roots: Float[Array, "f 3"]
    headings: Float[Array, " f"]
    speeds: Float[Array, " f"]


@typing.no_type_check
@flax.struct.dataclass
class _State:
    """What one frame hands to the next; `mode` is 0 for idle, 1 for running, 2 and more for the emotes, `clock` the
    frame of the emote, `blend` the decaying pose offset as rotation vectors (j + 1, 3), hips last."""

    heading: Array
    heading_rate: Array
    speed: Array
    speed_rate: Array
    position: Array
    phases: Array
    mode: Array
    clock: Array
    lean: Array
    lean_rate: Array
    blend: Array
    blend_rate: Array


def initial_state(
    clips: Clips, action: Int[Array, ""], key: Array, config: LocomotionConfig, heading: typing.Any
) -> _State:
    """Steady motion under `action`: running at full speed in its direction, or standing with the given heading."""
    running = (action > 0) & (action <= len(config.directions))
    yaw = jnp.asarray(config.directions, jnp.float32)[jnp.clip(action - 1, 0, 3)]
    zero = jnp.zeros(())
    blend = jnp.zeros((clips.idle.quats.shape[1] + 1, 3))
    return _State(
        heading=jnp.where(running, yaw, jnp.asarray(heading, jnp.float32)),
        heading_rate=zero,
        speed=jnp.where(running, clips.run_speed, 0.0),
        speed_rate=zero,
        position=jnp.zeros(2),
        phases=jax.random.uniform(key, (2,)),
        mode=_mode(action, jnp.zeros(()), config),
        clock=zero,
        lean=jnp.zeros(2),
        lean_rate=jnp.zeros(2),
        blend=blend,
        blend_rate=blend,
    )


def _mode(action: Array, speed: Array, config: LocomotionConfig) -> Array:
    """What to play under an action: an emote waits, idling, until the figure has nearly stopped."""
    running = (action > 0) & (action <= len(config.directions))
    mode = jnp.where(running, 1, 0)
    if not config.emotes:
        return mode
    emote = (action > len(config.directions)) & (speed < config.emote_speed)
    return jnp.where(emote, action - len(config.directions) + 1, mode)


def _source(clips: Clips, mode: Array, phases: Array, clock: Array) -> tuple[Array, Array]:
    standing, going = sample(clips.idle, phases[0]), sample(clips.run, phases[1])
    pose = jax.tree.map(lambda a, b: jnp.where(mode == 1, b, a), standing, going)
    if clips.emotes is None:
        return pose
    which, frame = _emote_frame(clips, mode, clock)
    played = clips.emotes.quats[which, frame], clips.emotes.hips[which, frame]
    return jax.tree.map(lambda a, b: jnp.where(mode > 1, b, a), pose, played)


def _emote_frame(clips: Clips, mode: Array, clock: Array) -> tuple[Array, Array]:
    which = jnp.clip(mode - 2, 0, len(clips.emote_frames) - 1)
    frame = jnp.clip(jnp.round(clock), 0, clips.emote_frames[which] - 1)
    return which, frame.astype(jnp.int32)


def _difference(a: tuple[Array, Array], b: tuple[Array, Array]) -> Array:
    """The offset that takes pose b to pose a: rotation vectors of the joints, then the hips' translation."""
    inverse = b[0] * jnp.array([[1.0, -1.0, -1.0, -1.0]])
    turn = rotations.to_axis_angle(rotations.multiply(a[0], inverse))
    return jnp.concatenate([turn, (a[1] - b[1])[None]])


def _offset(pose: tuple[Array, Array], blend: Array) -> tuple[Array, Array]:
    return rotations.multiply(rotations.from_axis_angle(blend[:-1]), pose[0]), pose[1] + blend[-1]


def _step(
    clips: Clips, config: LocomotionConfig, look: np.ndarray, state: _State, action: Array
) -> tuple[_State, tuple]:
    """Advance one frame under `action`; the output is the frame before it (`actions[k]` drives frame k to k + 1)."""
    dt = 1 / config.fps
    spring = functools.partial(springs.critical_step, dt=dt)
    pose = _offset(_source(clips, state.mode, state.phases, state.clock), state.blend)
    output = _place(pose, state, config, look), state

    mode = _mode(action, state.speed, config)
    running = mode == 1
    wanted = jnp.asarray(config.directions, jnp.float32)[jnp.clip(action - 1, 0, 3)]
    error = (wanted - state.heading + jnp.pi) % (2 * jnp.pi) - jnp.pi
    # Half a turn has two ways round: within three degrees of it, always take the one that increases the yaw.
    error = jnp.where(error < -jnp.pi + 0.05, error + 2 * jnp.pi, error)
    error = jnp.where(running, error, 0.0)
    heading, heading_rate = spring(
        state.heading, state.heading_rate, state.heading + error, frequency=config.turn_frequency
    )
    top = clips.run_speed * (1 - config.turn_slowdown * jnp.minimum(jnp.abs(error) / jnp.pi, 1))
    speed, speed_rate = spring(
        state.speed, state.speed_rate, jnp.where(running, top, 0.0), frequency=config.speed_frequency
    )
    effort = jnp.minimum(speed / clips.run_speed, 1.0)
    gait = _gait(clips, speed, config)
    rates = jnp.stack([jnp.ones(()) / clips.idle.quats.shape[0], gait / clips.run.quats.shape[0]]) * config.fps
    bank = jnp.clip(-config.lean_per_turn * heading_rate * effort, -config.lean_limit, config.lean_limit)
    pitch = jnp.clip(config.pitch_per_acceleration * speed_rate, -config.pitch_limit, config.pitch_limit)
    lean, lean_rate = spring(state.lean, state.lean_rate, jnp.stack([pitch, bank]), frequency=config.lean_frequency)

    # A standing figure sets off on the foot that the phase of the gait is nearer to.
    nearness = jnp.cos(2 * jnp.pi * (clips.start_phases - state.phases[1]))
    starting = running & (state.mode != 1) & (state.speed < config.emote_speed)
    start = jnp.where(nearness[0] > nearness[1], clips.start_phases[0], clips.start_phases[1])
    phases = state.phases.at[1].set(jnp.where(starting, start, state.phases[1]))
    # An emote that is over starts again, which is a switch like any other.
    switched = mode != state.mode
    clock = state.clock
    if clips.emotes is not None:
        which, _ = _emote_frame(clips, mode, clock)
        switched = switched | ((mode > 1) & (clock >= clips.emote_frames[which] - 1))
        clock = jnp.where(switched, 0.0, clock)

    # At a switch: the offset of the old motion from the new clip, here and one frame ago, gives its value and velocity.
    step = rates * dt
    old_before = _offset(
        _source(clips, state.mode, state.phases - step, state.clock - 1), state.blend - state.blend_rate * dt
    )
    fresh = _difference(pose, _source(clips, mode, phases, clock))
    fresh_before = _difference(old_before, _source(clips, mode, phases - step, clock - 1))
    blend = jnp.where(switched, fresh, state.blend)
    blend_rate = jnp.where(switched, (fresh - fresh_before) / dt, state.blend_rate)
    blend, blend_rate = spring(blend, blend_rate, 0.0, frequency=config.blend_frequency)

    direction = jnp.stack([jnp.sin(heading), jnp.cos(heading)])
    state = _State(
        heading=heading,
        heading_rate=heading_rate,
        speed=speed,
        speed_rate=speed_rate,
        position=state.position + direction * speed * dt,
        phases=phases + step,
        mode=mode,
        clock=clock + 1,
        lean=lean,
        lean_rate=lean_rate,
        blend=blend,
        blend_rate=blend_rate,
    )
    return state, output


def _gait(clips: Clips, speed: Array, config: LocomotionConfig) -> Array:
    """How fast the run's clip plays, 1 at full speed."""
    return config.slowest_gait + (1 - config.slowest_gait) * jnp.minimum(speed / clips.run_speed, 1.0)


def _place(pose: tuple[Array, Array], state: _State, config: LocomotionConfig, look: np.ndarray) -> tuple[Array, Array]:
    """Put a pose of the clip's frame into the world: heading, lean about the ground point, and the look into the
    turn."""
    quats, hips = pose
    zero = jnp.zeros(())
    yaw = rotations.from_axis_angle(jnp.stack([zero, state.heading, zero]))
    tilt = rotations.multiply(
        rotations.from_axis_angle(jnp.stack([zero, zero, state.lean[1]])),
        rotations.from_axis_angle(jnp.stack([state.lean[0], zero, zero])),
    )
    frame = rotations.multiply(yaw, tilt)
    twist = jnp.clip(config.look_per_turn * state.heading_rate, -config.look_limit, config.look_limit)
    turned = rotations.from_axis_angle(jnp.asarray(look)[:, None] * jnp.stack([zero, twist, zero])[None])
    quats = rotations.multiply(turned, quats)
    quats = quats.at[0].set(rotations.multiply(frame, quats[0]))
    hips = rotations.to_matrix(frame) @ hips + jnp.stack([state.position[0], zero, state.position[1]])
    return quats, hips


def simulate(
    rig: Rig,
    clips: Clips,
    actions: Int[Array, " f"],
    key: Array,
    config: LocomotionConfig = LocomotionConfig(),
    heading: Float[Array, ""] | float = 0.0,
) -> Motion:
    """The motion of f frames under one action id a frame, from steady motion under the first action.

    Starts at the origin of the ground. `key` draws the phases of the gait; `heading` (yaw, radians) is where a figure
    looks whose first action is idle. `jax.vmap` over actions, keys and headings makes batches.
    """
    motion, plan = _simulated(rig, clips, actions, key, config, heading)
    return motion if plan is None else _locked(rig, motion, plan)


@functools.partial(jax.jit, static_argnames="config")
def _simulated(
    rig: Rig, clips: Clips, actions: Array, key: Array, config: LocomotionConfig, heading: Array | float
) -> tuple[Motion, foot_plans.Plan | None]:
    """The motion before its feet are locked, and the plan for them; without `foot_lock` it stands on the ground."""
    look = _look(rig)
    state = initial_state(clips, actions[0], key, config, heading)
    step = functools.partial(_step, clips, config, look)
    _, ((quats, hips), states) = jax.lax.scan(step, state, actions)
    plan = transforms = None
    if config.foot_lock:
        plan = _plan(rig, clips, config, states)
    else:
        transforms = jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0))(rig, quats, hips)
        lift = _ground(rig, transforms, states.speed / clips.run_speed)
        transforms = transforms.at[..., 1, 3].add(lift[:, None])
        hips = hips.at[:, 1].add(lift)
    return Motion(quats, hips, transforms, _on_ground(states.position), states.heading, states.speed), plan


def follow(
    rig: Rig,
    clips: Clips,
    headings: Float[Array, " f"],
    speeds: Float[Array, " f"],
    phase: Float[Array, ""] | float = 0.0,
    config: LocomotionConfig = LocomotionConfig(),
) -> Motion:
    """A run with given headings (f,), yaw in radians, and speeds (f,), metres a second, both smooth in time.

    Starts at the origin, at `phase` (cycles) of the run's clip; the steps are as long as the speed makes them.
    """
    return _locked(rig, *_followed(rig, clips, headings, speeds, phase, config))


@functools.partial(jax.jit, static_argnames="config")
def _followed(
    rig: Rig, clips: Clips, headings: Array, speeds: Array, phase: Array | float, config: LocomotionConfig
) -> tuple[Motion, foot_plans.Plan]:
    dt = 1 / config.fps
    frames = headings.shape[0]
    rates, pushes = (jnp.asarray(jnp.gradient(x)) / dt for x in (headings, speeds))
    gaits = _gait(clips, speeds, config) * config.fps / clips.run.quats.shape[0]
    effort = jnp.minimum(speeds / clips.run_speed, 1.0)
    bank = jnp.clip(-config.lean_per_turn * rates * effort, -config.lean_limit, config.lean_limit)
    pitch = jnp.clip(config.pitch_per_acceleration * pushes, -config.pitch_limit, config.pitch_limit)
    moved = _forward(headings) * (speeds * dt)[:, None]
    phases = phase + jnp.cumsum(gaits * dt) - gaits[0] * dt
    still = jnp.zeros(frames)
    states = _State(
        heading=headings,
        heading_rate=rates,
        speed=speeds,
        speed_rate=pushes,
        position=jnp.cumsum(moved, axis=0) - moved[0][None],
        phases=jnp.stack([still, phases], axis=1),
        mode=jnp.ones(frames, jnp.int32),
        clock=still,
        lean=jnp.stack([pitch, bank], axis=1),
        lean_rate=jnp.zeros((frames, 2)),
        blend=jnp.zeros((frames, 1, 3)),
        blend_rate=jnp.zeros((frames, 1, 3)),
    )
    look = _look(rig)
    quats, hips = jax.vmap(lambda s: _place(sample(clips.run, s.phases[1]), s, config, look))(states)
    motion = Motion(quats, hips, None, _on_ground(states.position), headings, speeds)
    return motion, _plan(rig, clips, config, states)


def _locked(rig: Rig, motion: Motion, plan: foot_plans.Plan) -> Motion:
    """The motion with its feet on the plan; a program of its own, which all motions of one length share."""
    quats, hips, transforms = footsteps.lock_feet(rig, motion.local_quats, motion.hips, plan)
    return motion.replace(local_quats=quats, hips=hips, transforms=transforms)


def _on_ground(places: Float[Array, "f 2"]) -> Float[Array, "f 3"]:
    return jnp.insert(places, 1, 0.0, axis=1)


def _look(rig: Rig) -> np.ndarray:
    look = np.zeros(len(rig.names), np.float32)
    look[[rig.index(name) for name in ("Spine1", "Neck", "Head")]] = 1 / 3
    return look


def _plan(rig: Rig, clips: Clips, config: LocomotionConfig, states: _State) -> foot_plans.Plan:
    """Where the feet should be in every frame of `states` (leading axis f)."""
    dt = 1 / config.fps
    home = foot_plans.standing(rig, jax.tree.map(lambda x: x[0], clips.idle_feet))

    # Running: the clip's feet, the stride as long as the speed makes it, turned a little ahead of the body.
    gait = _gait(clips, states.speed, config)
    stride = jnp.minimum(states.speed / (gait * clips.run_speed), 1.2)
    back = states.position - _forward(states.heading) * (states.speed * dt)[:, None]
    ahead = states.heading + states.heading_rate * config.foot_lookahead
    phases = states.phases[:, 1]
    rate = gait / clips.run.quats.shape[0]
    run, run_before = (
        jax.vmap(functools.partial(_warp, home, clips.run_feet))(p, stride) for p in (phases, phases - rate)
    )
    now = foot_plans.in_world(run, states.position, ahead)
    before = foot_plans.in_world(run_before, back, ahead - states.heading_rate * dt)

    # Standing: where the figure will have come to rest, which the springs of speed and heading say.
    rest, facing = _resting(config, states, dt)
    homes = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(phases), *x.shape)), home)
    stand = foot_plans.in_world(homes, rest, facing)
    stand_before = jax.tree.map(lambda x: jnp.concatenate([x[:1], x[:-1]]), stand)
    running = states.mode == 1
    tolerance = jnp.where(running, jnp.inf, config.step_tolerance)

    choices = [(running, now, before), (~running, stand, stand_before)]
    if clips.emotes is not None:
        played, played_before = (
            foot_plans.in_world(
                jax.vmap(functools.partial(_emote_feet, clips))(states.mode, states.clock - k), rest, facing
            )
            for k in (0, 1)
        )
        choices.append((states.mode > 1, played, played_before))
        tolerance = jnp.where(states.mode > 1, config.emote_tolerance, tolerance)
    pivot_lag = jnp.where(running, config.pivot_lag, jnp.pi)
    # Of no weak type, so that all plans share the program that locks feet.
    return foot_plans.plan(choices, *(x.astype(jnp.float32) for x in (tolerance, pivot_lag)))


def _forward(heading: Array) -> Array:
    return jnp.stack([jnp.sin(heading), jnp.cos(heading)], axis=-1)


def _warp(home: foot_plans.Feet, feet: foot_plans.Feet, phase: Array, stride: Array) -> foot_plans.Feet:
    """The running feet at a phase with their strides, and the height they swing to, scaled to a slower figure."""
    run = foot_plans.sample_feet(feet, phase)
    flat = home.balls[:, 1]
    lifted = flat + (run.balls[:, 1] - flat) * (0.4 + 0.6 * jnp.minimum(stride, 1.0))
    balls = jnp.stack([run.balls[:, 0], lifted, run.balls[:, 2] * stride], axis=-1)
    return run.replace(balls=balls)


def _resting(config: LocomotionConfig, states: _State, dt: float) -> tuple[Array, Array]:
    """Place (f, 2) and yaw (f,) in which the figure would come to rest if no key were held from this frame on."""
    w = config.turn_frequency * dt
    decay = math.exp(-w)
    facing = states.heading + states.heading_rate * dt * decay / (1 - (1 - w) * decay)
    distance = 2 * states.speed / config.speed_frequency + states.speed_rate / config.speed_frequency**2
    # Most of the way is covered early: its direction is nearer to the present heading than to the last.
    return states.position + _forward(0.6 * states.heading + 0.4 * facing) * distance[:, None], facing


def _emote_feet(clips: Clips, mode: Array, clock: Array) -> foot_plans.Feet:
    which, frame = _emote_frame(clips, mode, clock)
    return jax.tree.map(lambda x: x[which, frame], clips.emote_feet)


def _ground(rig: Rig, transforms: Array, effort: Array) -> Array:
    """Vertical shift (f,) that keeps the soles out of the ground, and a standing figure on it; a run may fly."""
    lowest = jax.vmap(skinning.sole_points, in_axes=(None, 0))(rig, transforms)[..., 1].min(axis=(1, 2))
    standing = jnp.clip(1 - 2.5 * effort, 0, 1)
    return -jnp.minimum(lowest, 0) - jnp.maximum(lowest, 0) * standing
