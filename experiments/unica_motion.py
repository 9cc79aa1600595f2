"""How a trained avatar moves: long rollouts under many keys, and forecasts from held-out frames, beside the controller.

Everything is measured on geometry. What a rollout is compared with is measured in the same way on the controller's own
sequences, so that the limits of the measurement count on both sides.
"""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import unica
from avatarjax.data import avatars, dataset, skinning
from avatarjax.data.dataset import Dataset
from avatarjax.data.sequences import Recording
from avatarjax.metrics import drift, foot_slide, joints, motion, responsiveness
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.unica import fit, forecast
from experiments.unica_rollout import before_each_action

LONG = 2000  # frames of a rollout, as UNICA Fig. 6
HOLD = 60  # frames a key is held in it, as UNICA C.4
FORECAST = 60  # frames, the three given ones included
# A frame further than this from the nearest training frame, metres, has lost the figure.
LOST = 10.0
_FITTED = 1500


@dataclasses.dataclass
class Long:
    """A long rollout up to where it is lost, in metres: actions (f,), root-relative texels (f, t, 3), roots (f, 3)
    after each action, distance (f,) to the nearest training frame and height (f,) of the lowest point."""

    actions: np.ndarray
    texels: np.ndarray
    roots: np.ndarray
    distance: np.ndarray
    height: np.ndarray


def long_script(frames: int, actions: int, seed: int) -> np.ndarray:
    """Another key every HOLD frames, drawn among all actions, from standing."""
    rng, keys = np.random.default_rng(seed), [0]
    while len(keys) * HOLD < frames + HOLD:
        keys.append(int(rng.choice([k for k in range(actions) if k != keys[-1]])))
    return np.repeat(keys[1:], HOLD)[:frames].astype(np.int32)


def roll_long(avatar: unica.Avatar, data: Dataset, seed: int, frames: int = LONG) -> Long:
    """Roll so many frames out under changing keys, without appearance."""
    actions = long_script(frames, avatar.config.actions, seed)
    state = unica.reset(avatar, jax.random.key(seed))
    roll = jax.jit(unica.rollout, static_argnames="gaussians")
    rolled = roll(avatar, state, jnp.asarray(actions), gaussians=False)[1]
    texels, roots = (np.asarray(x) for x in (forecast.surfaces(avatar.atlas, rolled), rolled.root))
    good = np.isfinite(texels).all((1, 2)) & np.isfinite(roots).all(1) & (np.abs(texels).max((1, 2)) < LOST)
    count = len(good) if good.all() else int(np.argmin(good))
    distance = drift.nearest_distance(texels[:count], np.asarray(data.train.texels)) if count else np.zeros(0)
    return Long(actions[:count], texels[:count], roots[:count], distance, np.asarray(rolled.info.ground)[:count])


def trends(rolled: Long) -> dict[str, drift.Trend]:
    """Trends, in mm, of the distance to the nearest training frame and of the lowest point's height."""
    curves = {"distance to the nearest training frame": rolled.distance, "height of the lowest point": rolled.height}
    # A stretch of three keys is a block: what one key does to the curve is over by then.
    fits = len(rolled.distance) >= 9 * HOLD
    return {name: drift.trend(1000 * curve, block=3 * HOLD) for name, curve in curves.items()} if fits else {}


def asked(data: Dataset, actions: int) -> tuple[np.ndarray, np.ndarray]:
    """World yaw and movement flag of every action, measured on the training data."""
    ground = np.asarray(data.train.roots)[:, [0, 2, 1]]
    return fit.action_directions(ground, np.asarray(data.train.actions), np.asarray(data.train.sequence), actions)


def answers(data: Dataset, avatar: unica.Avatar, rolled: Long) -> dict[str, dict[str, typing.Any]]:
    """Frames of turning by the angle asked for, and heading error: of the long rollout and the held-out recordings."""
    yaw, moves = asked(data, avatar.config.actions)
    found = {"rollout": []}
    if len(rolled.roots) > HOLD:
        paths = before_each_action(avatar, rolled.roots)
        found["rollout"] = [responsiveness.responses(paths, rolled.actions, yaw, moves)]
    found["controller"] = [
        responsiveness.responses(roots, actions, yaw, moves) for roots, actions in _sequences(data.held_out)
    ]
    return {name: _answers(each) for name, each in found.items()}


def _answers(sequences: list[list[dict[str, typing.Any]]]) -> dict[str, typing.Any]:
    records = [r for sequence in sequences for r in sequence if r["start"] and "heading_error" in r]
    result: dict[str, typing.Any] = {}
    for angle in (180, 90):
        turns = [r for r in records if r["turn"] is not None and abs(r["turn"] - angle) < 15]
        settled = [r for r in turns if r["turn_frames"] is not None]
        result[f"turns of {angle} degrees"] = len(turns)
        result[f"turns of {angle} degrees completed"] = len(settled)
        for kind in ("turn_frames", "transition_frames"):
            result[f"{kind} {angle}"] = bootstrap([r[kind] for r in settled]) if settled else None
    result["heading_error"] = bootstrap([r["heading_error"] for r in records]) if records else None
    return result


def slides(data: Dataset, rolled: Long) -> dict[str, typing.Any]:
    """Foot slide in mm a contact of the long rollout and of the held-out recordings, on the same sole texels."""
    try:
        feet = foot_slide.surface_feet(np.asarray(data.standing))
    except ValueError as error:
        return {"not measured": str(error)}
    found = {"rollout": [feet.slides(rolled.texels + rolled.roots[:, None])] if len(rolled.roots) else []}
    recording = data.held_out
    world = recording.texels + recording.roots[:, None]
    found["controller"] = [feet.slides(world[recording.sequence == k]) for k in np.unique(recording.sequence)]
    result: dict[str, typing.Any] = {}
    for name, each in found.items():
        values = 1000 * np.concatenate([*each, np.zeros(0)])
        result[name] = None
        if len(values):
            groups = None if len(each) == 1 else np.repeat(np.arange(len(each)), [len(s) for s in each])
            result[name] = {"mean": bootstrap(values, groups), "median": float(np.median(values))}
    return result


def joint_motion(
    name: str, folder: Path, seed: int, data: Dataset, built: dict[str, unica.Avatar], rolled: Long
) -> dict[str, typing.Any]:
    """Motion errors of forecasts of the held-out sequences, and the share of frames that spike in the long rollout.

    Joints of generated geometry are regressed from its surface; the truth is the skeleton that drove the recording, in
    its held-out sequences' first FORECAST frames, of which three are given. "surface of the truth" is the error of the
    regressor alone, "no acceleration" that of going on as before. `folder` has the data of the avatar of that name.
    """
    rig = avatars.build(name).rig
    chosen = [k for k, name in enumerate(rig.names) if "Hand" not in name or name.endswith("Hand")]
    held = data.held_out
    train = _joints(folder, "train", rig, chosen, np.unique(data.train.sequence))
    true = _joints(folder, "held_out", rig, chosen, np.unique(held.sequence))
    every = max(1, len(train) // _FITTED)
    regressor = joints.fit(np.asarray(data.train.texels[::every]), train[::every])
    surface = np.asarray(joints.regress(regressor, held.texels))
    result: dict[str, typing.Any] = {
        "joints": len(chosen),
        "regressor_mm": bootstrap(1000 * np.linalg.norm(surface - true, axis=-1).mean(1), held.sequence),
    }
    starts = np.flatnonzero(np.append(True, np.diff(held.sequence) != 0))
    lengths = np.diff(np.append(starts, len(held.sequence)))
    first = starts[lengths >= FORECAST]
    if len(first):
        rows = first[:, None] + np.arange(FORECAST)
        truth = (true + held.roots[:, None])[rows]
        predicted = {"surface of the truth": (surface + held.roots[:, None])[rows], "no acceleration": 0 * truth}
        for model, avatar in built.items():
            texels, roots = forecast.forecast(avatar, held, first, FORECAST - 3, jax.random.key(seed))
            ahead = np.asarray(joints.regress(regressor, texels)) + roots[:, :, None]
            predicted[model] = np.concatenate([predicted["surface of the truth"][:, :3], ahead], axis=1)
        result["motion_error_mm"] = {model: _errors(x, truth) for model, x in predicted.items()}
    calm = [motion.accelerations(x) for x in _split(surface + held.roots[:, None], held.sequence)]
    threshold = motion.spike_threshold(np.concatenate(calm))
    result["spikes"] = {"threshold_mm": 1000 * threshold, "controller": _share(calm, threshold)}
    if len(rolled.roots) > 3 * HOLD:
        paths = np.asarray(joints.regress(regressor, rolled.texels)) + rolled.roots[:, None]
        # The stretch of one key is a group.
        accelerations = motion.accelerations(paths)
        result["spikes"]["rollout"] = _share(np.array_split(accelerations, len(accelerations) // HOLD), threshold)
    return result


def _errors(predicted: np.ndarray, truth: np.ndarray) -> dict[str, Estimate] | None:
    """Both motion errors in mm a frame squared, over frames in groups of sequences; None if the forecast is lost."""
    if not np.isfinite(predicted).all() or np.abs(predicted).max() > 1000:
        return None
    labels = np.repeat(np.arange(len(truth)), truth.shape[1] - 3)
    result = {}
    for name, of in (("all joints", motion.acceleration_errors), ("a joint", motion.joint_acceleration_errors)):
        # The first acceleration is that of the three given frames.
        each = [of(p, t)[1:] for p, t in zip(predicted, truth, strict=True)]
        result[name] = bootstrap(1000 * np.concatenate(each), labels)
    return result


def _share(accelerations: list[np.ndarray], threshold: float) -> Estimate:
    marks = [motion.spikes(a, threshold) for a in accelerations]
    return bootstrap(np.concatenate(marks), np.repeat(np.arange(len(marks)), [len(m) for m in marks]))


def _joints(folder: Path, split: str, rig: typing.Any, chosen: list[int], clips: np.ndarray) -> np.ndarray:
    """True joints (f, j, 3) of a split relative to their roots, metres."""
    parts = []
    for k in clips:
        take = dataset.load_take(folder, split, int(k))
        parts.append(np.asarray(skinning.joint_paths(rig, take.quats, take.hips))[:, chosen] - take.roots[:, None])
    return np.concatenate(parts)


def _split(values: np.ndarray, sequence: np.ndarray) -> list[np.ndarray]:
    return [values[sequence == k] for k in np.unique(sequence)]


def _sequences(recording: Recording) -> list[tuple[np.ndarray, np.ndarray]]:
    """Roots and actions of each sequence of a recording."""
    roots, actions = _split(recording.roots, recording.sequence), _split(recording.actions, recording.sequence)
    return list(zip(roots, actions, strict=True))
