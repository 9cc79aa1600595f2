"""What holds over long rollouts: time a frame and turns (UNICA Table D), and sliding FVD over 2,000 frames (Fig. 6)."""

from __future__ import annotations

import statistics
import time
import typing
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from avatarjax import posmap, unica
from avatarjax.metrics import drift, fvd, published
from avatarjax.metrics.report import draw_band
from avatarjax.posmap import pca as pcs
from experiments import pictures, unica_motion
from experiments.tables.finished import Finished, video_network
from experiments.tables.table import Notebook, Table
from experiments.unica_rollout import SCRIPT

REPEATS = 10  # of the script: 2,000 frames (UNICA 4.1)
STRIDE = 16  # frames between windows; the paper's 10 would take eight times as many clips
_CALLS = 30


def times(runs: list[Finished], notebook: Notebook) -> Table:
    """UNICA Table D: seconds of each part of a frame, and frames that turns take."""
    rows = []
    for run in runs:
        for dynamics in run.dynamics():
            name = f"{run.mark(dynamics)}, times"
            found = notebook.measured(name, lambda run=run, d=dynamics: _times(run.avatar(d)))
            turns = notebook.measured(f"{name}, turns", lambda run=run, d=dynamics: _turns(run, run.avatar(d)))
            seconds = [found[part] for part in published.UNICA_D_SECONDS.columns]
            rows.append([f"{run.name}, {dynamics}", *seconds, *turns["rollout"]])
        rows.append([f"{run.name}, controller", *[None] * 4, *turns["controller"]])
    paper = [published.UNICA_D_SECONDS.at(published.UNICA, c) for c in published.UNICA_D_SECONDS.columns]
    for row, name in ((published.UNICA, "paper, NVIDIA 3090"), ("ground truth", "paper, ground truth")):
        angles = [published.UNICA_D_TURNS.at(row, c) for c in published.UNICA_D_TURNS.columns]
        rows.append([name, *(paper if row == published.UNICA else [None] * 4), *angles])
    return Table(
        "Time a frame, and frames of turning (UNICA Table D)",
        f"Medians of {_CALLS} jitted calls after compilation, seconds; others: what a jitted step with Gaussians takes "
        "beyond its three parts, none where it takes less, because a step compiled whole shares work. Turns: from the "
        "key change to the first frame from which the movement stays within 12 degrees of the new direction for 8 "
        f"frames, in a rollout of {unica_motion.LONG} frames and in the held-out recordings of the controller.",
        ["", *(f"{c}, s" for c in published.UNICA_D_SECONDS.columns), "180 degrees, frames", "90 degrees, frames"],
        rows,
    )


def _times(avatar: unica.Avatar) -> dict[str, float]:
    state = unica.reset(avatar, jax.random.key(0))
    geometry = jax.jit(lambda avatar, state: unica.rollout(avatar, state, np.ones(1, np.int32), gaussians=False))
    frame = jax.tree.map(lambda x: x[0], geometry(avatar, state)[1])
    texels = posmap.from_map(avatar.atlas, frame.posmap)
    found = {
        "geometry": _seconds(lambda: geometry(avatar, state)),
        "appearance": _seconds(lambda f=jax.jit(unica.dress), a=avatar.replace(pca=None): f(a, frame)),
        "PCA": 0.0 if avatar.pca is None else _seconds(lambda f=jax.jit(pcs.align): f(avatar.pca, texels)),
    }
    whole = _seconds(lambda f=jax.jit(unica.step): f(avatar, state, 1))
    return {**found, "others": max(0.0, whole - sum(found.values()))}


def _seconds(work: Callable[[], typing.Any]) -> float:
    jax.block_until_ready(work())
    taken = []
    for _ in range(_CALLS):
        began = time.perf_counter()
        jax.block_until_ready(work())
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def _turns(run: Finished, avatar: unica.Avatar) -> dict[str, list[typing.Any]]:
    """Frames of turning by 180 and by 90 degrees, of the avatar and of the controller."""
    found = unica_motion.answers(run.data, avatar, unica_motion.roll_long(avatar, run.data, 0))
    angles = ("turn_frames 180", "turn_frames 90")
    return {who: [answers.get(angle) for angle in angles] for who, answers in found.items()}


def sliding(runs: list[Finished], notebook: Notebook, folder: Path, script: tuple[int, ...] = SCRIPT) -> Table:
    """UNICA Fig. 6: FVD in a sliding window over the script repeated, with its trend."""
    rows, shown = [], []
    for run in runs:
        avatar = run.avatar()
        name = f"{run.mark(avatar.config.dynamics)}, sliding FVD of {REPEATS * len(script)} frames"
        found = notebook.measured(name, lambda run=run, avatar=avatar: _sliding(run, avatar, script))
        starts, values = np.asarray(found["starts"]), np.asarray(found["values"])
        trend = drift.trend(values, block=max(2, len(values) // 10))
        low, high = (1000 / STRIDE * bound for bound in trend.slope_interval)
        slope = 1000 / STRIDE * trend.slope
        rows.append([run.name, float(values.mean()), float(trend.std), f"{slope:.3g} [{low:.3g}, {high:.3g}]"])
        path = folder / f"sliding-{run.name}-{run.folder.name}.png"

        def draw(axes, starts=starts, values=values, trend=trend):
            axes.plot(starts, values, lw=1.2, label="window of 200 frames")
            draw_band(axes, starts, trend.line, trend.line - trend.std, trend.line + trend.std, "trend, 1 std")
            axes.set(xlabel="first frame of the window", ylabel="FVD", ylim=(0, None))
            axes.legend()

        pictures.save_plot(path, draw)
        shown.append((path.name, f"Sliding FVD of {run.name}, {run.folder.name}"))
    remark = f"The paper prints no numbers in Fig. 6; it calls the trend near flat. Windows every {STRIDE} frames."
    return Table(
        "Stability over 2,000 frames (UNICA Fig. 6)",
        "FVD (mean of four views) of windows of 200 frames of one rollout, the report's script ten times, against the "
        "meshes under the script once. The slope in FVD a thousand frames, with a block-bootstrap interval.",
        ["", "mean", "std about the trend", "slope in 1,000 frames"],
        rows,
        [remark],
        shown,
    )


def _sliding(run: Finished, avatar: unica.Avatar, script: tuple[int, ...]) -> dict[str, list[float]]:
    video = run.video(avatar, 0, script * REPEATS)
    window = min(fvd.WINDOW, len(script))
    found = fvd.sliding(video_network(), video, run.truth_features, window=window, stride=STRIDE)
    return {"starts": found.starts.tolist(), "values": [one.per_view_mean for one in found.values]}
