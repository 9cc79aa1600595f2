"""Motion clips of the shipped asset, fitted to one rig: local rotations and the hips' path at 30 frames a second."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax import rotations
from avatarjax.data import body, skinning
from avatarjax.io import weights

# Quaternion components are stored as int16 multiples of 1 / QUAT_UNIT.
QUAT_UNIT = 32767.0
# The emotes' hips rest one metre above the ground.
_SOURCE_HIPS = 1.0
_FPS = 30.0


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
    """The clips that locomotion blends, and run_speed: metres a second at which the running feet do not slide."""

    idle: Clip
    run: Clip
    run_speed: Float[Array, ""]


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


def load_clips(rig: body.Rig) -> Clips:
    """Idle and run for a rig, both set on the ground, with the run's own speed measured from its stance feet."""
    idle, run = load_clip("idle", rig), load_clip("run", rig)
    idle_low = _sole_heights(rig, idle)[0].min(axis=(1, 2))
    idle = idle.replace(hips=idle.hips.at[:, 1].add(-idle_low))
    heights, points = _sole_heights(rig, run)
    run = run.replace(hips=run.hips.at[:, 1].add(-np.percentile(heights.min(axis=(1, 2)), 10)))
    # A point of the sole near the ground travels backwards at the speed of the run.
    backwards = -np.diff(points[..., 2], axis=0, append=points[:1, ..., 2]) * _FPS
    stance = heights < np.percentile(heights, 12)
    return Clips(idle, run, jnp.float32(np.median(backwards[stance])))


def sample(clip: Clip, phase: Float[Array, ""]) -> tuple[Float[Array, "j 4"], Float[Array, " 3"]]:
    """Pose of a looping clip at a phase in cycles (any real number): local rotations (j, 4) and hips (3,)."""
    count = clip.quats.shape[0]
    position = (phase % 1.0) * count
    first = jnp.floor(position).astype(jnp.int32) % count
    weight = position - jnp.floor(position)
    second = (first + 1) % count
    quats = rotations.nlerp(clip.quats[first], clip.quats[second], jnp.full(clip.quats.shape[1], weight))
    return quats, clip.hips[first] * (1 - weight) + clip.hips[second] * weight


def _sole_heights(rig: body.Rig, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    transforms = jax.jit(jax.vmap(lambda q, h: skinning.forward_kinematics(rig, q, h)))(clip.quats, clip.hips)
    points = np.asarray(jax.vmap(lambda t: skinning.sole_points(rig, t))(transforms))
    return points[..., 1], points
