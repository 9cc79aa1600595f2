"""What is measured of one trained dynamics model: next frames, rollouts, diversity, sampling steps, time a frame.

Everything is measured on geometry, in millimetres, on the same held-out frames and keys for every model.
"""

from __future__ import annotations

import dataclasses
import time
import typing

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import unica
from avatarjax.data.dataset import Dataset
from avatarjax.metrics import responsiveness
from avatarjax.unica import batches, evaluate, forecast
from avatarjax.unica.latent import LatentDynamics
from experiments import unica_motion
from experiments.unica_rollout import before_each_action

GROUPS = 256  # held-out groups whose next frame is predicted
STEP_GROUPS = 64  # of them, for the comparison of sampling steps
SAMPLING_STEPS = (1, 2, 4, 10, 20)  # UNICA Table B
OBEYED_DEGREES = 15.0
STARTS, REPEATS = 4, 4  # places in the held-out data, and rollouts from each that differ in their PRNG key only
AHEAD = 60  # frames of such a rollout
TIMED = 60


def measure(avatar: unica.Avatar, data: Dataset, seed: int, frames: int) -> dict[str, typing.Any]:
    """All measures of one model as JSON has them; `frames` is the length of the long rollout."""
    return {
        "next_frame": next_frame(avatar, data, seed),
        "sampling_steps": sampling_steps(avatar, data, seed),
        "rollout": rollout(avatar, data, seed, frames),
        "diversity": diversity(avatar, data, seed),
        "ms_a_frame": milliseconds(avatar),
    }


def chosen_groups(data: Dataset, window: tuple[int, int], count: int) -> np.ndarray:
    """Evenly spaced held-out groups."""
    windows = batches.windows(data.held_out, 4, window)
    return np.unique(np.linspace(0, len(windows.first) - 1, count).astype(int))


def next_frame(avatar: unica.Avatar, data: Dataset, seed: int) -> dict[str, typing.Any]:
    """Errors in mm of each held-out group's next frame, of trivial guesses, and of the autoencoder if there is one."""
    window = avatar.config.turn_window
    chosen = chosen_groups(data, window, GROUPS)
    errors = evaluate.one_step(avatar, data, chosen, jax.random.key(seed + 11))
    if isinstance(avatar.dynamics, LatentDynamics):
        errors |= {"autoencoder": evaluate.reconstruction(avatar, data, chosen)["autoencoder"]}
    first = batches.windows(data.held_out, 4, window).first[chosen]
    errors["sequence"] = np.asarray(data.held_out.sequence)[first]
    return {name: np.round(np.asarray(values, np.float64), 3).tolist() for name, values in errors.items()}


def sampling_steps(avatar: unica.Avatar, data: Dataset, seed: int) -> dict[str, float]:
    """Mean error in mm of the next frame against the number of sampling steps (UNICA Table B has it in pictures)."""
    chosen = chosen_groups(data, avatar.config.turn_window, STEP_GROUPS)
    found = {}
    for steps in SAMPLING_STEPS:
        errors = evaluate.one_step(with_steps(avatar, steps), data, chosen, jax.random.key(seed + 11))
        found[str(steps)] = float(errors["model"].mean())
    return found


def with_steps(avatar: unica.Avatar, steps: int) -> unica.Avatar:
    """The avatar with another number of sampling steps."""
    name = "latent" if isinstance(avatar.dynamics, LatentDynamics) else "coefficients"
    part = dataclasses.replace(getattr(avatar.config, name), sample_steps=steps)
    return avatar.replace(config=dataclasses.replace(avatar.config, **{name: part}))


def rollout(avatar: unica.Avatar, data: Dataset, seed: int, frames: int) -> dict[str, typing.Any]:
    """A long rollout under changing keys: how they are answered, and whether it leaves what it learned."""
    rolled = unica_motion.roll_long(avatar, data, seed, frames)
    yaw, moves = unica_motion.asked(data, avatar.config.actions)
    trend = unica_motion.trends(rolled).get("distance to the nearest training frame")
    found: dict[str, typing.Any] = {"frames": len(rolled.roots)}
    if trend is not None:
        found["distance_mm"] = 1000 * float(rolled.distance.mean())
        found["drift_mm_in_1000_frames"] = 1000 * trend.slope
        found["drift_interval"] = [1000 * bound for bound in trend.slope_interval]
    if len(rolled.roots) <= unica_motion.HOLD:
        return found
    paths = before_each_action(avatar, rolled.roots)
    return found | answers(paths, rolled.actions, yaw, moves) | {"path": np.round(paths, 3).tolist()}


def answers(paths: np.ndarray, actions: np.ndarray, yaw: np.ndarray, moves: np.ndarray) -> dict[str, typing.Any]:
    """How a root path (f, 3) answers its keys: heading error, share of keys obeyed, turns, speeds."""
    records = responsiveness.responses(paths, actions, yaw, moves)
    headed = [r for r in records if "heading_error" in r]
    idle = [r["speed"] for r in records if "heading_error" not in r]
    found: dict[str, typing.Any] = {
        "heading_error": float(np.mean([r["heading_error"] for r in headed])),
        "obeyed": float(np.mean([r["heading_error"] < OBEYED_DEGREES for r in headed])),
        "keys": len(headed),
        "speed": float(np.mean([r["speed"] for r in headed])),
        "idle_speed": float(np.mean(idle)) if idle else None,
    }
    for angle in (180, 90):
        turns = [r for r in headed if r.get("turn") is not None and abs(r["turn"] - angle) < 15]
        settled = [r["turn_frames"] for r in turns if r["turn_frames"] is not None]
        found[f"turns_{angle}"], found[f"turns_{angle}_completed"] = len(turns), len(settled)
        found[f"turn_frames_{angle}"] = float(np.mean(settled)) if settled else None
    return found


def controller(data: Dataset, actions: int) -> dict[str, typing.Any]:
    """The same of the held-out recordings, and how far two of their poses are apart, mm: the scale of diversity."""
    yaw, moves = unica_motion.asked(data, actions)
    held = data.held_out
    parts = [held.sequence == k for k in np.unique(held.sequence)]
    each = [answers(held.roots[rows], held.actions[rows], yaw, moves) for rows in parts]
    names = ("heading_error", "obeyed", "speed", "idle_speed", "turn_frames_180", "turn_frames_90")
    values = {name: [e[name] for e in each if e[name] is not None] for name in names}
    apart = held.texels[::7][None] - held.texels[3::11][:, None]
    found = {name: float(np.mean(v)) if v else None for name, v in values.items()}
    return found | {"two_poses_mm": 1000 * float(np.linalg.norm(apart, axis=-1).mean())}


def diversity(avatar: unica.Avatar, data: Dataset, seed: int) -> dict[str, list[float | None]]:
    """How far rollouts from the same true frames under the same keys are apart, frame after frame.

    Mean distance over pairs in mm: of root-relative texels ("pose") and of roots ("place").
    """
    held = data.held_out
    starts = np.flatnonzero(np.append(True, np.diff(held.sequence) != 0))
    first = starts[np.linspace(0, len(starts) - 1, STARTS).astype(int)]
    ahead = min(AHEAD, int(np.diff(np.append(starts, len(held.sequence))).min()) - 3)
    texels, roots = forecast.forecast(avatar, held, np.repeat(first, REPEATS), ahead, jax.random.key(seed + 23))
    found = {}
    for name, points in (("pose", texels), ("place", roots[:, :, None])):
        rolled = points.reshape(len(first), REPEATS, *points.shape[1:])
        pairs = [(i, j) for i in range(REPEATS) for j in range(i)]
        apart = np.mean([np.linalg.norm(rolled[:, i] - rolled[:, j], axis=-1).mean((0, 2)) for i, j in pairs], axis=0)
        found[name] = [round(1000 * float(x), 3) if np.isfinite(x) else None for x in apart]
    return found


def milliseconds(avatar: unica.Avatar) -> float:
    """Time of a frame's geometry inside a compiled rollout, ms: the best of three runs."""
    roll = jax.jit(lambda avatar, state, keys: unica.rollout(avatar, state, keys, gaussians=False)[1].root)
    state, keys = unica.reset(avatar, jax.random.key(0)), jnp.ones(TIMED, jnp.int32)
    jax.block_until_ready(roll(avatar, state, keys))
    taken = []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(roll(avatar, state, keys))
        taken.append(time.perf_counter() - began)
    return 1000 * min(taken) / TIMED
