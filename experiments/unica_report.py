"""The report of a UNICA run: every stage beside a trivial baseline on held-out data, pictures, and what is poor."""

from __future__ import annotations

import dataclasses
import json
import platform
import sys
import typing

import jax
import jax.numpy as jnp
import numpy as np

import avatarjax
from avatarjax import posmap, unica
from avatarjax.data.dataset import Dataset
from avatarjax.data.sequences import ACTIONS
from avatarjax.io import atomic
from avatarjax.metrics import drift, responsiveness
from avatarjax.metrics.report import Report
from avatarjax.unica import batches, evaluate, fit
from experiments import pictures

if typing.TYPE_CHECKING:
    from experiments.unica import Experiment

GROUPS = 400


def write(
    experiment: Experiment,
    data: Dataset,
    built: dict[str, unica.Avatar],
    frames: unica.Frame,
    script: tuple[int, ...],
) -> None:
    """Measure, plot and write metrics.json and report.html into the run's folder."""
    folder = experiment.folder
    driver = experiment.config.dynamics
    avatar = built[driver]
    windows = batches.windows(data.held_out, 4, experiment.config.turn_window)
    chosen = np.unique(np.linspace(0, len(windows.first) - 1, GROUPS).astype(int))
    key = jax.random.key(experiment.args.seed + 11)
    yaw, moves = _asked(data)

    paths = {driver: _before_each_action(avatar, np.asarray(frames.root))}
    paths |= {name: _path(one, script, experiment.args.seed) for name, one in built.items() if name != driver}
    truth = np.asarray(data.truth.roots)
    answers = {name: responsiveness.responses(p, np.asarray(script), yaw, moves) for name, p in paths.items()}
    answers["controller"] = responsiveness.responses(truth, np.asarray(script), yaw, moves)
    errors = {name: evaluate.one_step(one, data, chosen, key) for name, one in built.items()}
    measured: dict[str, typing.Any] = {
        "one_step_mm": {n: _split(e) for n, e in errors.items()},
        "responses": answers,
        "components_mm": evaluate.components(avatar, data, chosen),
        "psnr": {
            label: _summary(evaluate.image_psnr(one, images, refined=refined))
            for label, one, images, refined in (
                ("untrained base, standing pose", evaluate.untrained_base(avatar, data), data.standing_images, False),
                ("base attributes, standing pose", avatar, data.standing_images, False),
                ("base attributes, held-out poses", avatar, data.held_out_images, False),
                ("with appearance network, held-out poses", avatar, data.held_out_images, True),
            )
        },
    }
    if "unet" in built:
        measured["autoencoder_mm"] = {
            n: _summary(e) for n, e in evaluate.reconstruction(built["unet"], data, chosen).items()
        }
    nearest = _nearest(avatar, data, frames)
    measured["drift_mm"] = {n: _summary(x) for n, x in nearest.items()}
    ground = np.asarray(frames.info.ground)
    measured["ground_mm"] = {
        int(k): round(1000 * float(ground[k]), 2) for k in np.linspace(0, len(ground) - 1, 5).astype(int)
    }
    measured["seconds"] = experiment.seconds
    atomic.write_text(folder / "metrics.json", json.dumps(measured, indent=2))

    pictures.plot_paths(folder / "path.png", {"controller": truth, **paths})
    pictures.plot_lines(
        folder / "components.png",
        {"held-out maps": np.asarray(list(measured["components_mm"].items()))},
        "components kept",
        "error, mm",
        logy=True,
    )
    pictures.plot_lines(folder / "drift.png", nearest, "frame", "distance to the nearest training frame, mm")
    _page(experiment, measured, built, script).write(folder / "report.html")


def _page(
    experiment: Experiment,
    measured: dict[str, typing.Any],
    built: dict[str, unica.Avatar],
    script: tuple[int, ...],
) -> Report:
    folder, config = experiment.folder, experiment.config
    page = Report(f"UNICA: {experiment.args.avatar}, preset {experiment.args.preset}")
    page.code("python -m experiments.unica " + " ".join(sys.argv[1:]))
    page.text(
        f"Keys: 60 frames W, 60 S, 60 A, 20 idle at 30 frames a second, from standing. Dynamics: {config.dynamics}. "
        "Views: front, left side, back and right side; the camera follows, squares are half a metre."
    )
    page.media(folder / "video.mp4", "The rollout: every frame is generated from the three before it and the key.")
    page.media(folder / "contact_sheet.png", f"Frames {pictures.key_frames(script)}, four views.")

    page.heading("Does it obey?")
    page.media(folder / "path.png", "Root paths from above, and the controller's that made the training data.")
    page.table(
        f"Answers to the keys. Turning is over when the movement direction stays within "
        f"{responsiveness.TOLERANCE_DEGREES:.0f} degrees for {responsiveness.HOLD_FRAMES} frames; heading error and "
        "speed are means from 25 frames after the change. n = 1 rollout.",
        ["", "key", "speed, m/s", "heading error, degrees", "turn, degrees", "frames of turning"],
        [
            (name, ACTIONS[r["action"]], r["speed"], r.get("heading_error"), r.get("turn"), r.get("turn_frames"))
            for name, records in measured["responses"].items()
            for r in records
        ],
    )

    page.heading("Each stage against what costs nothing, on held-out data")
    rows, verdicts = _stage_rows(measured)
    page.table(
        "Mean and 95 % interval (normal, over n). Green: better than the baseline.",
        ["stage", "ours", "trivial baseline", "n", "verdict"],
        rows,
        verdicts=verdicts,
    )
    page.media(folder / "components.png", "Alignment error against the number of components (as UNICA Fig. B).")
    page.media(folder / "drift.png", "Drift: the rollout, and for comparison the controller under the same keys.")
    page.text(f"Height of the lowest point by frame, mm (a trend is vertical drift): {measured['ground_mm']}.")

    page.heading("What is poor")
    for line in _poor(rows, verdicts, measured):
        page.text(line)

    page.heading("Training")
    page.table("Seconds a stage took", ["stage", "seconds"], [[k, float(v)] for k, v in experiment.seconds.items()])
    for plot in sorted((folder / "checkpoints").glob("*.png")):
        page.media(plot, f"Loss of {plot.stem}")
    page.heading("Configuration")
    page.text(
        f"avatarjax on Python {platform.python_version()}, jax {jax.__version__}, {jax.default_backend()} "
        f"({platform.machine()}); {len(built)} dynamics model(s); package {avatarjax.__name__}."
    )
    page.code(json.dumps(dataclasses.asdict(config), indent=2))
    return page


def _stage_rows(measured: dict[str, typing.Any]) -> tuple[list[tuple], list[bool | None]]:
    rows, verdicts = [], []

    def add(stage, ours, baseline, *, higher=False, unit=""):
        better = ours["mean"] > baseline["mean"] if higher else ours["mean"] < baseline["mean"]
        rows.append(
            (stage, _interval(ours, unit), _interval(baseline, unit), ours["n"], "beats it" if better else "does not")
        )
        verdicts.append(bool(better))

    for name, error in measured["one_step_mm"].items():
        for part in ("all groups", "turning groups"):
            for guess in ("copy last", "constant velocity"):
                add(
                    f"{name}, next frame, {part}, against {guess}", error[part]["model"], error[part][guess], unit=" mm"
                )
    if "autoencoder_mm" in measured:
        each = measured["autoencoder_mm"]
        add("autoencoder, against the mean map", each["autoencoder"], each["mean map"], unit=" mm")
    counts = measured["components_mm"]
    most, fewer = max(counts), sorted(counts)[-2]
    rows.append(
        (
            f"PCA with {most} components, against {fewer}",
            f"{counts[most]:.3g} mm",
            f"{counts[fewer]:.3g} mm",
            GROUPS,
            "beats it" if counts[most] < counts[fewer] else "does not",
        )
    )
    verdicts.append(counts[most] < counts[fewer])
    psnr = measured["psnr"]
    add(
        "base attribute map, standing pose, against untrained attributes",
        psnr["base attributes, standing pose"],
        psnr["untrained base, standing pose"],
        higher=True,
        unit=" dB",
    )
    add(
        "appearance network, against the base attribute map",
        psnr["with appearance network, held-out poses"],
        psnr["base attributes, held-out poses"],
        higher=True,
        unit=" dB",
    )
    return rows, verdicts


def _poor(rows: list[tuple], verdicts: list[bool | None], measured: dict[str, typing.Any]) -> list[str]:
    lines = [f"{row[0]}: {row[1]} against {row[2]}." for row, good in zip(rows, verdicts, strict=True) if not good]
    for name, records in measured["responses"].items():
        for r in records:
            if r.get("heading_error", 0.0) > 15:
                lines.append(
                    f"{name}: {r['heading_error']:.0f} degrees off the wanted direction under {ACTIONS[r['action']]}."
                )
            if "turn" in r and r["start"] and r["turn_frames"] is None:
                lines.append(f"{name}: never settles into the direction of {ACTIONS[r['action']]}.")
    return lines or ["Nothing fell behind its baseline, and every key was answered; see the numbers for how well."]


def _split(error: dict[str, np.ndarray]) -> dict[str, dict[str, dict[str, float]]]:
    turning = error["turning"]
    parts = {"all groups": np.ones_like(turning), "turning groups": turning}
    names = ("model", "copy last", "constant velocity")
    return {part: {n: _summary(error[n][rows]) for n in names} for part, rows in parts.items()}


def _summary(values: np.ndarray) -> dict[str, float]:
    values = np.asarray(values, np.float64).ravel()
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else float("nan")
    return {"mean": float(values.mean()), "interval": float(half), "n": len(values)}


def _interval(s: dict[str, float], unit: str) -> str:
    return f"{s['mean']:.2f} ± {s['interval']:.2f}{unit}"


def _asked(data: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """World yaw and movement flag of every action, measured on the training data."""
    ground = np.asarray(data.train.roots)[:, [0, 2, 1]]
    return fit.action_directions(ground, np.asarray(data.train.actions), np.asarray(data.train.sequence), len(ACTIONS))


def _path(avatar: unica.Avatar, script: tuple[int, ...], seed: int) -> np.ndarray:
    roll = jax.jit(unica.rollout, static_argnames="gaussians")
    state = unica.reset(avatar, jax.random.fold_in(jax.random.key(seed), 7))
    return _before_each_action(avatar, np.asarray(roll(avatar, state, jnp.asarray(script), gaussians=False)[1].root))


def _before_each_action(avatar: unica.Avatar, roots: np.ndarray) -> np.ndarray:
    """Roots (f, 3) at the frames where each action sets in, as recordings have them, from those after each action."""
    start = unica.reset(avatar, jax.random.key(0)).offset
    return np.concatenate([np.asarray(start)[None], roots[:-1]])


def _nearest(avatar: unica.Avatar, data: Dataset, frames: unica.Frame) -> dict[str, np.ndarray]:
    """Distance in mm of rollout and held-out frames to the nearest training frame."""
    texels = jax.vmap(lambda m: posmap.from_map(avatar.atlas, m))(jnp.asarray(frames.posmap))
    texels = (texels - jax.vmap(lambda x: posmap.root(avatar.atlas, x))(texels)[:, None]) / avatar.atlas.scale
    training = np.asarray(data.train.texels)
    return {
        "rollout": 1000 * drift.nearest_distance(np.asarray(texels), training),
        "controller, same keys": 1000 * drift.nearest_distance(np.asarray(data.truth.texels), training),
    }
