"""What is measured of a model of clothes in motion: where nodes are, how much they swing, how late, how smoothly."""

from __future__ import annotations

import typing
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from avatarjax.metrics import drift, motion
from avatarjax.nets.functional import Params
from avatarjax.smad import dynamics, linear
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.dynamics import System
from avatarjax.smad.linear import Linear
from avatarjax.smad.train_dynamics import Take
from experiments import pictures
from experiments.smad_motions import Name

SETTLE = 15  # frames after the start that no measure counts: a rollout begins at rest, a motion does not
LOOSE = 0.3  # the share of nodes that count as loose
LAGS = 10  # frames up to which a delay is looked for
LOST = 10.0  # metres from the root beyond which a node is no further off: a rollout that diverged has an error too
WINDOW = 15  # frames of half a second, in which poses are compared with those that were learned from
BLOCK = 30  # frames of a long sequence that are averaged, and drawn together for its trend's interval

# Nodes (t, n, 3) in the body frame of every frame of a take; None where nothing is known.
Method = typing.Callable[[Name, Take], np.ndarray | None]
Found = dict[str, typing.Any]  # by part: lists over its motions, as JSON has them


def label(name: Name) -> str:
    """A motion in a table."""
    return f"{name[0]}-{name[1]}"


def of_avatar(config: SmadConfig, params: Params, system: System) -> Method:
    """A rollout from rest under the poses of a take."""

    @jax.jit
    def roll(params, system, poses):
        state = dynamics.reset(config, params, system, jax.tree.map(lambda x: x[0], poses))
        first = dynamics.positions(system, state)
        return jnp.concatenate([first[None], dynamics.rollout(config, params, system, state, _after(poses))[1]])

    return lambda _, take: np.asarray(roll(params, system, take.poses))


def of_equilibrium(config: SmadConfig, params: Params, system: System) -> Method:
    """The equilibrium alone, without swing."""
    return lambda _, take: np.asarray(dynamics.without_swing(config, params, system, take.poses)[1])


def of_linear(config: SmadConfig, model: Linear, system: System) -> Method:
    """A linear yardstick."""

    @jax.jit
    def roll(model, system, poses):
        features = dynamics.pose_features(config, system, poses)
        return dynamics.surfaces(system, poses) + linear.rollout(model, features)

    return lambda _, take: np.asarray(roll(model, system, take.poses))


def of_skinning(system: System) -> Method:
    """The driven surface alone."""
    return lambda _, take: np.asarray(dynamics.surfaces(system, take.poses))


def loose(offsets: Float[np.ndarray, "f n 3"]) -> Int[np.ndarray, " m"]:
    """The nodes that are furthest from their mean offset in training."""
    apart = np.linalg.norm(offsets - offsets.mean(axis=0), axis=-1).mean(axis=0)
    return np.argsort(apart)[-max(1, round(LOOSE * len(apart))) :]


def measure(
    method: Method,
    parts: Mapping[str, Mapping[Name, Take]],
    chosen: Int[np.ndarray, " m"],
    reference: Method,
) -> Found:
    """All measures of a method, in millimetres; `reference` is the one whose errors say what a spike is."""
    found: Found = {part: {} for part in parts}
    for part, takes in parts.items():
        for name, take in takes.items():
            nodes = method(name, take)
            if nodes is None:
                continue
            nodes = np.clip(np.nan_to_num(nodes, nan=LOST), -LOST, LOST)
            truth = np.asarray(take.positions)
            if part == "long":
                found[part][label(name)] = long_errors(nodes, truth, chosen)
                continue
            threshold = motion.spike_threshold(_jerks(_known(reference(name, take)), truth, chosen))
            for what, value in one_take(nodes, truth, chosen, threshold).items():
                found[part].setdefault(what, []).append(value)
    return found


def one_take(
    nodes: Float[np.ndarray, "t n 3"],
    truth: Float[np.ndarray, "t n 3"],
    chosen: Int[np.ndarray, " m"],
    threshold: float,
) -> dict[str, typing.Any]:
    """Mean distances (mm) of all and of chosen nodes; of the chosen their speed as a share of the true one, how many
    milliseconds the true motion comes later, the acceleration error (mm a frame squared), the share of spikes, and the
    distance in each window of frames."""
    apart = 1000 * np.linalg.norm(nodes - truth, axis=-1)[SETTLE:]
    mine, true = (np.diff(x[SETTLE:, chosen], axis=0) for x in (nodes, truth))
    errors = _jerks(nodes, truth, chosen)
    return {
        "all": float(apart.mean()),
        "loose": float(apart[:, chosen].mean()),
        "swing": float(np.sqrt(np.mean(mine**2) / np.mean(true**2))),
        "lag": 1000 / 30 * delay(mine, true),
        "acceleration": float(errors.mean()),
        "spikes": float(motion.spikes(errors, threshold).mean()),
        "windows": _cut(apart[:, chosen].mean(axis=1), WINDOW).mean(axis=1).tolist(),
    }


def similarity(
    config: SmadConfig, system: System, parts: Mapping[str, Mapping[Name, Take]]
) -> dict[str, list[list[float]]]:
    """How like the poses of each window of the motions of the test and of unseen ones are to the nearest of those that
    were learned from, whenever they begin there."""
    features = {
        part: [np.asarray(dynamics.pose_features(config, system, take.poses)) for take in takes.values()]
        for part, takes in parts.items()
    }
    known = np.concatenate([_shifted(x) for x in features["train"]])

    def one(x):
        return motion.nearest_correlation(_cut(x[SETTLE:], WINDOW).reshape(-1, known.shape[1]), known).tolist()

    return {part: [one(x) for x in features[part]] for part in ("test", "unseen")}


def _shifted(features: Float[np.ndarray, "t p"]) -> Float[np.ndarray, "k wp"]:
    """All windows, from every frame on."""
    return np.stack([features[k : k + WINDOW].reshape(-1) for k in range(len(features) - WINDOW + 1)])


def _cut(values: np.ndarray, frames: int) -> np.ndarray:
    """Whole pieces (k, frames, ...) of so many frames, one after the other."""
    return values[: len(values) // frames * frames].reshape(-1, frames, *values.shape[1:])


def delay(mine: Float[np.ndarray, "t n 3"], true: Float[np.ndarray, "t n 3"], most: int = LAGS) -> float:
    """By how many frames the true velocities come after a method's: where their correlation is highest, between frames
    by a parabola. Raises ValueError for fewer than three times as many frames as are looked through."""
    if len(mine) < 3 * most:
        raise ValueError(f"a delay of up to {most} frames needs {3 * most} frames, there are {len(mine)}")
    here = mine[most : len(mine) - most]
    found = []
    for shift in range(-most, most + 1):
        there = true[most + shift : len(true) - most + shift]
        size = np.sqrt(np.sum(here**2) * np.sum(there**2))
        found.append(float(np.sum(here * there) / size) if size > 0 else 0.0)
    best = int(np.argmax(found))
    if best in (0, len(found) - 1):
        return float(best - most)
    low, middle, high = found[best - 1 : best + 2]
    return best - most + 0.5 * (low - high) / (low - 2 * middle + high)


def long_errors(
    nodes: Float[np.ndarray, "t n 3"], truth: Float[np.ndarray, "t n 3"], chosen: Int[np.ndarray, " m"]
) -> dict[str, typing.Any]:
    """Of a long sequence: the mean error of chosen nodes (mm), its growth in mm in 1,000 frames with bounds, and the
    error over time, a value a block of frames."""
    errors = 1000 * np.linalg.norm(nodes - truth, axis=-1)[SETTLE:, chosen].mean(axis=1)
    line = drift.trend(errors, block=BLOCK)
    blocks = _cut(errors, BLOCK).mean(axis=1)
    growth = [1000 * float(x) for x in (line.slope, *line.slope_interval)]
    return {"loose": float(errors.mean()), "growth": growth, "curve": blocks.tolist()}


def draw_nodes(
    path: Path, methods: Mapping[str, Method], take: Take, name: Name, shown: Sequence[str], columns: int = 6
) -> None:
    """Nodes from the side in some frames of a take: a row for the truth and for each method that is shown."""
    frames = np.linspace(SETTLE, len(take.positions) - 1, columns).round().astype(int)
    rows = {"truth": np.asarray(take.positions)} | {n: _known(methods[n](name, take)) for n in shown}

    wide, high = 1.6, 2.0  # metres that one figure takes up

    def draw(axes):
        for row, (method, nodes) in enumerate(rows.items()):
            axes.text(-0.8, 1.0 - high * row, method)
            for column, frame in enumerate(frames):
                x, y = nodes[frame, :, 2] + wide * column, nodes[frame, :, 1] - high * row
                axes.scatter(x, y, s=2, c=nodes[frame, :, 0], cmap="viridis")
        axes.set_aspect("equal")
        axes.set_axis_off()

    pictures.save_plot(path, draw, size=(wide * columns, high * len(rows)))


def _jerks(nodes: np.ndarray, truth: np.ndarray, chosen: np.ndarray) -> Float[np.ndarray, " t"]:
    return motion.joint_acceleration_errors(1000 * nodes[SETTLE:, chosen], 1000 * truth[SETTLE:, chosen])


def _known(nodes: np.ndarray | None) -> np.ndarray:
    assert nodes is not None
    return nodes


def _after(poses):
    return jax.tree.map(lambda x: x[1:], poses)
