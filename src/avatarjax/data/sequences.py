"""Key presses to recorded motion: which sequences are simulated, and their position maps as texels."""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax import posmap
from avatarjax.data import dressing
from avatarjax.data.body import Rig
from avatarjax.data.motion import clips, locomotion
from avatarjax.data.motion.locomotion import Motion
from avatarjax.data.wardrobe.assembly import AvatarMesh
from avatarjax.physics import xpbd

ACTIONS = ("idle", "forward", "backward", "left", "right")
# Frames under the first key before a sequence begins: simulated, so that the cloth has found its way, but not recorded.
LEAD_IN = 30
# Frames, at least and at most, for which a chain holds a key.
HOLD = (35, 80)
# Frames of the transition from one action (row) to another (column), in the order of ACTIONS (UNICA Table A).
TABLE_A = (
    (0, 367, 362, 359, 362),
    (264, 0, 330, 304, 308),
    (264, 334, 0, 306, 304),
    (234, 312, 307, 0, 329),
    (260, 310, 309, 328, 0),
)


@typing.no_type_check
@flax.struct.dataclass
class Take:
    """f frames of one sequence as NumPy arrays.

    texels (f, t, 3) metres relative to the root of their own frame; roots (f, 3) the waist in the world; actions (f,)
    where actions[k] drives frame k to k + 1; quats (f, j, 4) local rotations of the bones from the rest pose and hips
    (f, 3) metres, with j = 0 where the skeleton is not known.
    """

    texels: Float[np.ndarray, "f t 3"]
    roots: Float[np.ndarray, "f 3"]
    actions: Int[np.ndarray, " f"]
    quats: Float[np.ndarray, "f j 4"]
    hips: Float[np.ndarray, "f 3"]


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


def transition_scripts(frames: int | None, seed: int, actions: int = len(ACTIONS)) -> list[Int[np.ndarray, " f"]]:
    """All ordered pairs of different actions, a sequence each (UNICA A): the source for about a third, then the target.

    Every sequence has `frames` frames or, for None, those of UNICA Table A (five actions). The turning point varies by
    up to a twelfth of the sequence's length, so that it meets the gait in many phases. Raises ValueError where a
    sequence is too short to hold a turn, or where the table has no such action.
    """
    if frames is None and actions != len(ACTIONS):
        raise ValueError(f"UNICA's Table A has {len(ACTIONS)} actions, not {actions}: give a number of frames")
    if frames is not None and frames < 60:
        raise ValueError(f"a transition needs at least 60 frames to settle before and after the turn, got {frames}")
    rng = np.random.default_rng(seed)
    scripts = []
    for source in range(actions):
        for target in range(actions):
            if source != target:
                length = frames or TABLE_A[source][target]
                turn = length // 3 + int(rng.integers(0, max(1, length // 12)))
                scripts.append(np.array([source] * turn + [target] * (length - turn), np.int32))
    return scripts


def chain_scripts(frames: int | None, seed: int, actions: int = len(ACTIONS)) -> list[Int[np.ndarray, " f"]]:
    """As many sequences of the same lengths as `transition_scripts`, but a new key every HOLD frames (ours).

    Several times as many turns in the same time. The next key is always that to which the last one has led least often,
    so that all ordered pairs come equally often. Raises ValueError as `transition_scripts`.
    """
    rng = np.random.default_rng(seed)
    led = np.zeros((actions, actions))
    np.fill_diagonal(led, np.inf)
    scripts, key = [], int(rng.integers(actions))
    for length in (len(script) for script in transition_scripts(frames, seed, actions)):
        keys = [key] * int(rng.integers(*HOLD, endpoint=True))
        while len(keys) < length:
            following = int(rng.choice(np.flatnonzero(led[key] == led[key].min())))
            led[key, following] += 1
            key = following
            keys += [key] * int(rng.integers(*HOLD, endpoint=True))
        scripts.append(np.array(keys[:length], np.int32))
    return scripts


# How training sequences press keys, by name.
SCRIPTS = {"transitions": transition_scripts, "chains": chain_scripts}


def simulate(
    avatar: AvatarMesh,
    scripts: Sequence[Int[np.ndarray, "_f"]],
    headings: Float[np.ndarray, " n"],
    leads: Sequence[int],
    seed: int,
) -> list[Motion]:
    """The controller's motion under each script of keys, after LEAD_IN frames under the key that `leads` names.

    `headings` (n,) yaw in radians is where a script looks that starts idle; gait phases are drawn by `seed`. All
    scripts run in one batch, padded to one length, so that the controller is compiled once.
    """
    longest = max(len(script) for script in scripts)
    batch = np.stack([np.pad(s, (LEAD_IN, longest - len(s)), mode="edge") for s in scripts])
    batch[:, :LEAD_IN] = np.asarray(leads)[:, None]
    looping = clips.load_clips(avatar.rig)
    keys = jax.random.split(jax.random.key(seed), len(batch))
    motions = jax.device_get(_run(avatar.rig, looping, jnp.asarray(batch), keys, jnp.asarray(headings, jnp.float32)))
    return [jax.tree.map(lambda x, k=k, s=s: x[k, : LEAD_IN + len(s)], motions) for k, s in enumerate(scripts)]


@jax.jit
def _run(rig: Rig, looping: clips.Clips, batch: Array, keys: Array, headings: Array) -> Motion:
    return jax.vmap(lambda a, k, h: locomotion.simulate(rig, looping, a, k, heading=h))(batch, keys, headings)


def take(
    avatar: AvatarMesh,
    atlas: posmap.Atlas,
    motion: Motion,
    actions: Int[np.ndarray, " f"],
    config: xpbd.XPBDConfig = xpbd.XPBDConfig(),
    progress: Callable[[int], typing.Any] | None = None,
) -> tuple[Take, Float[np.ndarray, "f v 3"]]:
    """What one motion with LEAD_IN frames before it gives, clothes and hair simulated, and the vertices (f, v, 3)
    relative to the root of their frame, metres."""
    vertices = dressing.simulate(avatar, motion.transforms, config, progress=progress)[LEAD_IN:]
    quats, hips = (np.asarray(a[LEAD_IN:], np.float32) for a in (motion.local_quats, motion.hips))
    return encode(atlas, vertices, actions, quats, hips)


def encode(
    atlas: posmap.Atlas,
    vertices: Float[np.ndarray, "f v 3"],
    actions: Int[np.ndarray, " f"],
    quats: Float[np.ndarray, "f j 4"],
    hips: Float[np.ndarray, "f 3"],
) -> tuple[Take, Float[np.ndarray, "f v 3"]]:
    """The take of a sequence of world vertices (f, v, 3), and the vertices relative to the root of their frame."""
    texels = np.asarray(_encode(atlas, vertices))
    roots = np.einsum("t,ftc->fc", np.asarray(atlas.waist), texels).astype(np.float32)
    take = Take(texels - roots[:, None], roots, np.asarray(actions, np.int32), quats, hips)
    return take, vertices - roots[:, None]


@jax.jit
def _encode(atlas: posmap.Atlas, vertices: Array) -> Array:
    return jax.vmap(posmap.encode, in_axes=(None, 0))(atlas, vertices)


def join(takes: Sequence[Take]) -> Recording:
    """Takes one after the other."""
    return Recording(
        texels=np.concatenate([t.texels for t in takes]),
        roots=np.concatenate([t.roots for t in takes]),
        actions=np.concatenate([t.actions for t in takes]),
        sequence=np.repeat(np.arange(len(takes), dtype=np.int32), [len(t.actions) for t in takes]),
    )


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
