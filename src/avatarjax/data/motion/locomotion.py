"""A keyboard-driven runner: held keys in, poses of a skeleton at 30 frames a second out, as one jitted `lax.scan`.

The key sets the wanted direction of movement in the world. Springs act on the angle of the heading and on the scalar
speed, never on the velocity vector: the figure turns about, it does not slide through a standstill. Idle and run follow
each other by inertialisation (Bollo 2018, "Inertialization: high-performance animation transitions in Gears of War"):
at a switch the difference of pose and its velocity are kept and decay to nothing on top of the new clip.
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
from avatarjax.data.motion.clips import Clips, sample
from avatarjax.physics import springs


@dataclasses.dataclass(frozen=True)
class LocomotionConfig:
    """Constants of the runner. Angles in radians, frequencies in radians a second; action 0 is idle.

    `turn_frequency` is tuned to UNICA's turns: 12 frames for 180 degrees and 9 for 90 until the movement direction
    stays within 12 degrees of the new one.
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
    """What one frame hands to the next; `blend` is the decaying pose offset as rotation vectors (j + 1, 3), hips
    last."""

    heading: Array
    heading_rate: Array
    speed: Array
    speed_rate: Array
    position: Array
    phases: Array
    running: Array
    lean: Array
    lean_rate: Array
    blend: Array
    blend_rate: Array


def initial_state(
    clips: Clips, action: Int[Array, ""], key: Array, config: LocomotionConfig, heading: typing.Any
) -> _State:
    """Steady motion under `action`: running at full speed in its direction, or standing with the given heading."""
    running = action > 0
    yaw = jnp.asarray(config.directions, jnp.float32)[jnp.maximum(action - 1, 0)]
    zero = jnp.zeros(())
    blend = jnp.zeros((clips.idle.quats.shape[1] + 1, 3))
    return _State(
        heading=jnp.where(running, yaw, jnp.asarray(heading, jnp.float32)),
        heading_rate=zero,
        speed=jnp.where(running, clips.run_speed, 0.0),
        speed_rate=zero,
        position=jnp.zeros(2),
        phases=jax.random.uniform(key, (2,)),
        running=running,
        lean=jnp.zeros(2),
        lean_rate=jnp.zeros(2),
        blend=blend,
        blend_rate=blend,
    )


def _source(clips: Clips, running: Array, phases: Array) -> tuple[Array, Array]:
    standing, going = sample(clips.idle, phases[0]), sample(clips.run, phases[1])
    return jax.tree.map(lambda a, b: jnp.where(running, b, a), standing, going)


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
    pose = _offset(_source(clips, state.running, state.phases), state.blend)
    output = _place(pose, state, config, look), state.position, state.heading, state.speed

    running = action > 0
    wanted = jnp.asarray(config.directions, jnp.float32)[jnp.maximum(action - 1, 0)]
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
    gait = config.slowest_gait + (1 - config.slowest_gait) * effort
    rates = jnp.stack([jnp.ones(()) / clips.idle.quats.shape[0], gait / clips.run.quats.shape[0]]) * config.fps
    bank = jnp.clip(-config.lean_per_turn * heading_rate * effort, -config.lean_limit, config.lean_limit)
    pitch = jnp.clip(config.pitch_per_acceleration * speed_rate, -config.pitch_limit, config.pitch_limit)
    lean, lean_rate = spring(state.lean, state.lean_rate, jnp.stack([pitch, bank]), frequency=config.lean_frequency)

    # At a switch: the offset of the old motion from the new clip, here and one frame ago, gives its value and velocity.
    before = state.phases - rates * dt
    old_before = _offset(_source(clips, state.running, before), state.blend - state.blend_rate * dt)
    fresh = _difference(pose, _source(clips, running, state.phases))
    fresh_before = _difference(old_before, _source(clips, running, before))
    switched = running != state.running
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
        phases=state.phases + rates * dt,
        running=running,
        lean=lean,
        lean_rate=lean_rate,
        blend=blend,
        blend_rate=blend_rate,
    )
    return state, output


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


@functools.partial(jax.jit, static_argnames="config")
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
    look = np.zeros(len(rig.names), np.float32)
    look[[rig.index(name) for name in ("Spine1", "Neck", "Head")]] = 1 / 3
    state = initial_state(clips, actions[0], key, config, heading)
    step = functools.partial(_step, clips, config, look)
    _, ((quats, hips), positions, headings, speeds) = jax.lax.scan(step, state, actions)

    transforms = jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0))(rig, quats, hips)
    lift = _ground(rig, transforms, speeds / clips.run_speed)
    transforms = transforms.at[..., 1, 3].add(lift[:, None])
    hips = hips.at[:, 1].add(lift)
    roots = jnp.stack([positions[:, 0], jnp.zeros(len(actions)), positions[:, 1]], axis=1)
    return Motion(quats, hips, transforms, roots, headings, speeds)


def _ground(rig: Rig, transforms: Array, effort: Array) -> Array:
    """Vertical shift (f,) that keeps the soles out of the ground, and a standing figure on it; a run may fly."""
    lowest = jax.vmap(skinning.sole_points, in_axes=(None, 0))(rig, transforms)[..., 1].min(axis=(1, 2))
    standing = jnp.clip(1 - 2.5 * effort, 0, 1)
    return -jnp.minimum(lowest, 0) - jnp.maximum(lowest, 0) * standing
