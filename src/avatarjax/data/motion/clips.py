"""Motion clips of the shipped asset, fitted to one rig: local rotations and the hips' path at 30 frames a second."""

from __future__ import annotations

import typing
from collections.abc import Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.data import body, skinning
from avatarjax.data.motion import foot_plans
from avatarjax.data.motion.foot_plans import Feet
from avatarjax.io import weights

# Quaternion components are stored as int16 multiples of 1 / QUAT_UNIT.
QUAT_UNIT = 32767.0
# The emotes' hips rest one metre above the ground.
_SOURCE_HIPS = 1.0
_FPS = 30.0
# A start takes up the run this many frames after the landing of the foot that carries.
_START_FRAMES = 1.5


@typing.no_type_check
@flax.struct.dataclass
class Clip:
    """One motion on one rig: quats (f, j, 4) local rotations from the rest pose, hips (f, 3) metres, y from the
    ground."""

    quats: Float[Array, "f j 4"]
    hips: Float[Array, "f 3"]


@typing.no_type_check
@flax.struct.dataclass
class Clips:
    """The clips that locomotion blends, and run_speed: metres a second at which the running feet do not slide.

    start_phases (2,) are the phases of the run, in cycles, from which a standing figure sets off: one foot carries, the
    other swings. idle_feet and run_feet say where the feet of the two clips are and when they bear weight. emotes has
    one clip for each extra action, all padded to one length n: quats (e, n, j, 4), hips (e, n, 3), emote_feet with a
    leading axis e, emote_frames (e,) their own lengths; None where there are no extra actions.
    """

    idle: Clip
    run: Clip
    run_speed: Float[Array, ""]
    start_phases: Float[Array, " 2"]
    idle_feet: Feet
    run_feet: Feet
    emotes: typing.Any = None
    emote_feet: typing.Any = None
    emote_frames: typing.Any = None


def clip_names() -> tuple[str, ...]:
    """Names of the clips in the asset."""
    return tuple(weights.load_arrays(body.ASSET)[1]["clips"])


def load_clip(name: str, rig: body.Rig) -> Clip:
    """A clip fitted to the size of `rig`: the hips' path is scaled by leg length and centred on x = z = 0.

    Raises ValueError for a name that is not in the asset.
    """
    arrays, metadata = weights.load_arrays(body.ASSET)
    if name not in metadata["clips"]:
        raise ValueError(f"unknown clip {name!r}; the asset has {metadata['clips']}")
    quats = arrays[f"clips/{name}/quats"].astype(np.float32) / np.float32(QUAT_UNIT)
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    hips = arrays[f"clips/{name}/hips"]
    hips = hips - hips.mean(0) * np.array([1, 0, 1], np.float32)
    scale = np.float32(rig.heads[rig.index("Hips"), 1] / _SOURCE_HIPS)
    return Clip(jnp.asarray(quats), jnp.asarray(hips * scale))


def load_clips(rig: body.Rig, emotes: Sequence[str] = ()) -> Clips:
    """Idle and run for a rig, both set on the ground, with the run's own speed measured from its stance feet.

    `emotes` names clips of the asset that become extra actions, in this order.
    """
    idle, run = load_clip("idle", rig), load_clip("run", rig)
    idle_low = sole_heights(rig, idle)[0].min(axis=(1, 2))
    idle = idle.replace(hips=idle.hips.at[:, 1].add(-idle_low))
    heights, points = sole_heights(rig, run)
    run = run.replace(hips=run.hips.at[:, 1].add(-np.percentile(heights.min(axis=(1, 2)), 10)))
    # A point of the sole near the ground travels backwards at the speed of the run.
    backwards = -np.diff(points[..., 2], axis=0, append=points[:1, ..., 2]) * _FPS
    stance = heights < np.percentile(heights, 12)
    speed = float(np.median(backwards[stance]))
    idle_feet, run_feet = feet_of(rig, idle), feet_of(rig, run, speed)
    stands = np.asarray(run_feet.contacts)
    lands = (stands & ~np.roll(stands, 1, axis=0)).argmax(axis=0)
    starts = jnp.asarray((lands + _START_FRAMES) / len(stands) % 1.0, jnp.float32)
    looping = Clips(idle, run, jnp.float32(speed), starts, idle_feet, run_feet)
    if not emotes:
        return looping
    played = [ground_clip(rig, load_clip(name, rig)) for name in emotes]
    longest = max(len(clip.hips) for clip in played)
    feet = [feet_of(rig, clip, looping=False) for clip in played]

    def pad(x: Array) -> Array:
        return jnp.concatenate([x, jnp.repeat(x[-1:], longest - len(x), axis=0)])

    stack = jax.tree.map(lambda *xs: jnp.stack([pad(x) for x in xs]), *played)
    stacked_feet = jax.tree.map(lambda *xs: jnp.stack([pad(x) for x in xs]), *feet)
    frames = jnp.array([len(clip.hips) for clip in played], jnp.float32)
    return looping.replace(emotes=stack, emote_feet=stacked_feet, emote_frames=frames)


def ground_clip(rig: body.Rig, clip: Clip) -> Clip:
    """The clip raised or lowered as a whole so that its soles, where they are lowest, are on the ground."""
    lowest = sole_heights(rig, clip)[0].min(axis=(1, 2))
    return clip.replace(hips=clip.hips.at[:, 1].add(-np.percentile(lowest, 10)))


def feet_of(rig: body.Rig, clip: Clip, speed: float = 0.0, looping: bool = True) -> Feet:
    """Where the feet of a clip are, and when they bear weight if the figure moves at `speed` metres a second."""
    return foot_plans.clip_feet(rig, _kinematics(rig, clip.quats, clip.hips)[0], clip.quats, speed, looping)


def sample(clip: Clip, phase: Float[Array, ""]) -> tuple[Float[Array, "j 4"], Float[Array, " 3"]]:
    """Pose of a looping clip at a phase in cycles (any real number): local rotations (j, 4) and hips (3,)."""
    count = clip.quats.shape[0]
    position = (phase % 1.0) * count
    first = jnp.floor(position).astype(jnp.int32) % count
    weight = position - jnp.floor(position)
    second = (first + 1) % count
    quats = rotations.nlerp(clip.quats[first], clip.quats[second], jnp.full(clip.quats.shape[1], weight))
    return quats, clip.hips[first] * (1 - weight) + clip.hips[second] * weight


def sole_heights(rig: body.Rig, clip: Clip) -> tuple[Float[np.ndarray, "f 2 s"], Float[np.ndarray, "f 2 s 3"]]:
    """Heights and places of the sole points of a clip, metres."""
    points = np.asarray(_kinematics(rig, clip.quats, clip.hips)[1])
    return points[..., 1], points


@jax.jit
def _kinematics(rig: body.Rig, quats: Array, hips: Array) -> tuple[Array, Array]:
    transforms = jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0))(rig, quats, hips)
    return transforms, jax.vmap(skinning.sole_points, in_axes=(None, 0))(rig, transforms)
