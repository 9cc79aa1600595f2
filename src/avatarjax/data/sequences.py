"""Key presses to recorded motion: which sequences are simulated, and their position maps as texels."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax import posmap
from avatarjax.data import avatars
from avatarjax.data.avatars import AvatarMesh
from avatarjax.data.motion import clips, locomotion
from avatarjax.data.motion.locomotion import Motion

ACTIONS = ("idle", "forward", "backward", "left", "right")


@typing.no_type_check
@flax.struct.dataclass
class Recording:
    """f frames of one or more sequences, in order.

    texels (f, t, 3) metres relative to the root of their own frame; roots (f, 3) the waist in the world; actions (f,)
    where actions[k] drives frame k to k + 1; sequence (f,) which sequence a frame belongs to.
    """

    texels: Float[Array, "f t 3"]
    roots: Float[Array, "f 3"]
    actions: Int[Array, "f"]
    sequence: Int[Array, "f"]


def transition_scripts(frames: int, seed: int, actions: int = len(ACTIONS)) -> Int[np.ndarray, "n f"]:
    """All ordered pairs of different actions, a sequence each (UNICA A): the source for about a third, then the target.

    The turning point varies by up to a twelfth of the sequence's length, so that it meets the gait in many phases.
    Raises ValueError where a sequence is too short to hold a turn.
    """
    if frames < 60:
        raise ValueError(f"a transition needs at least 60 frames to settle before and after the turn, got {frames}")
    rng = np.random.default_rng(seed)
    scripts = []
    for source in range(actions):
        for target in range(actions):
            if source != target:
                turn = frames // 3 + int(rng.integers(0, max(1, frames // 12)))
                scripts.append([source] * turn + [target] * (frames - turn))
    return np.asarray(scripts, np.int32)


def simulate(
    avatar: AvatarMesh,
    plans: dict[str, Int[np.ndarray, "_n _f"]],
    headings: dict[str, Float[np.ndarray, "_n"]],
    seed: int,
) -> dict[str, Motion]:
    """The controller's motion under each plan's scripts (n, f), with leading axes n, f.

    `headings` (n,) yaw in radians is where a script looks that starts idle; gait phases are drawn by `seed`. All plans
    run in one batch, padded to one length, so that the controller is compiled once.
    """
    longest = max(scripts.shape[1] for scripts in plans.values())
    batch = np.concatenate([np.pad(s, ((0, 0), (0, longest - s.shape[1])), mode="edge") for s in plans.values()])
    looping = clips.load_clips(avatar.rig)
    keys = jax.random.split(jax.random.key(seed), len(batch))
    facing = np.concatenate([headings[name] for name in plans])
    run = jax.jit(jax.vmap(lambda a, k, h: locomotion.simulate(avatar.rig, looping, a, k, heading=h)))
    everything = run(jnp.asarray(batch), keys, jnp.asarray(facing, jnp.float32))

    motions, start = {}, 0
    for name, (n, f) in ((name, scripts.shape) for name, scripts in plans.items()):
        motions[name] = jax.tree.map(lambda x, a=start, n=n, f=f: x[a : a + n, :f], everything)
        start += n
    return motions


def record(avatar: AvatarMesh, atlas: posmap.Atlas, scripts: Int[np.ndarray, "n f"], motion: Motion) -> Recording:
    """Position-map texels of every frame of a batch of motions."""
    encode = jax.jit(jax.vmap(lambda v: posmap.encode(atlas, v)))
    texels, roots = [], []
    for k in range(len(scripts)):
        world = encode(jnp.asarray(vertices_of(avatar, motion, k)))
        root = jnp.einsum("t,ftc->fc", atlas.waist, world)
        texels.append(np.asarray(world - root[:, None]))
        roots.append(np.asarray(root))
    n, f = scripts.shape
    return Recording(
        texels=np.concatenate(texels),
        roots=np.concatenate(roots),
        actions=scripts.reshape(-1),
        sequence=np.repeat(np.arange(n, dtype=np.int32), f),
    )


def vertices_of(
    avatar: AvatarMesh, motion: Motion, sequence: int, frames: typing.Any = slice(None)
) -> Float[np.ndarray, "f v 3"]:
    """World vertices of chosen frames of one sequence of a batch of motions."""
    return avatars.pose_vertices(avatar, motion.transforms[sequence][frames], motion.lagged[sequence][frames])


def group_ends(sequence: Int[np.ndarray, "f"], length: int = 4) -> Int[np.ndarray, "g"]:
    """Last frames of all windows of `length` consecutive frames that lie inside one sequence, stride one."""
    ends = np.arange(length - 1, len(sequence))
    return ends[sequence[ends] == sequence[ends - length + 1]]


def turning(
    actions: Int[np.ndarray, "f"], sequence: Int[np.ndarray, "f"], window: tuple[int, int] = (0, 25)
) -> np.ndarray:
    """Frames (f,) bool that are reached within [low, high) frames of a key change (UNICA C.2: the 25 after it)."""
    changed = np.flatnonzero((actions[1:] != actions[:-1]) & (sequence[1:] == sequence[:-1])) + 1
    near = np.zeros(len(actions), bool)
    for k in changed:
        low, high = max(0, k + 1 + window[0]), min(len(actions), k + 1 + window[1])
        near[low:high] |= sequence[low:high] == sequence[k]
    return near
