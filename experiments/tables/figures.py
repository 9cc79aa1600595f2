"""The paper's figures: error against components (Fig. B), novel poses (C f), a trail (5), strips of keys (I to L)."""

from __future__ import annotations

import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import cameras, unica
from avatarjax.data.sequences import ACTIONS
from avatarjax.gaussians import Gaussians
from avatarjax.io import exr
from avatarjax.metrics import drift
from avatarjax.metrics.statistics import bootstrap
from avatarjax.posmap import pca as pcs
from avatarjax.splat import SplatConfig, render, required_capacity
from avatarjax.unica import evaluate, forecast, image_quality
from avatarjax.unica import train as training
from avatarjax.unica.avatar import wear
from experiments import pictures
from experiments.tables.finished import Finished
from experiments.tables.table import Notebook, Table
from experiments.unica_rollout import SCRIPT

COUNTS = (1, 5, 10, 20, 40, 80, 120, 160, 200, 256)  # components; the paper's curve bends at 120, it keeps 200
POSES = 400
TRAIL = 3  # every third frame, as UNICA Fig. 5
STRIP = 16  # frames of a strip of keys


def components(runs: list[Finished], notebook: Notebook, folder: Path) -> Table:
    """UNICA Fig. B: reconstruction error against the number of principal components."""
    curves = {}
    for run in runs:
        found = notebook.measured(f"{run.name}-{run.folder.name}, components", lambda run=run: _components(run))
        curves[run.name] = {int(k): v for k, v in found.items()}
    path = folder / "components.png"
    lines = {name: np.array(list(curve.items())) for name, curve in curves.items()}
    pictures.save_plot(
        path, lambda axes: pictures.draw_lines(axes, lines, "components", "error of held-out maps, mm", logy=True)
    )
    shared = [c for c in COUNTS if all(c in curve for curve in curves.values())]
    return Table(
        "Error against the number of principal components (UNICA Fig. B)",
        "Mean distance in mm between held-out heading-relative maps and their projection on components of the training "
        "maps. The paper projects a generated map, prints no numbers, sees its curves level off at about 120 and keeps "
        "200.",
        ["", *map(str, shared)],
        [[name, *(curve[c] for c in shared)] for name, curve in curves.items()],
        pictures=[(path.name, "Error against components")],
    )


def _components(run: Finished) -> dict[int, float]:
    train = jnp.asarray(training.coefficient_frames(run.data, run.data.train)[0])
    held = training.coefficient_frames(run.data, run.data.held_out)[0]
    held = held[np.unique(np.linspace(0, len(held) - 1, POSES).astype(int))]
    most = min(*train.shape, COUNTS[-1] + 1) - 1
    return evaluate.projection_errors(pcs.fit(train, most, jax.random.key(0)), held, COUNTS, 1.0)


def novelty(runs: list[Finished], folder: Path) -> Table:
    """UNICA Fig. C (f): the generated pose that is furthest from all training poses, beside the nearest of them."""
    rows, shown = [], []
    for run in runs:
        avatar, training_poses = run.avatar(), np.asarray(run.data.train.texels)
        frames = _rolled(avatar)
        texels = np.asarray(forecast.surfaces(avatar.atlas, frames))
        ours = 1000 * drift.nearest_distance(texels, training_poses)
        truth = 1000 * drift.nearest_distance(np.asarray(run.data.truth.texels), training_poses)
        rows.append([run.name, bootstrap(ours), float(ours.max()), bootstrap(truth), float(truth.max())])
        furthest = int(ours.argmax())
        apart = np.sqrt(((training_poses - texels[furthest]) ** 2).sum(-1).mean(1))
        pair = [wear(avatar, jnp.asarray(x)) for x in (texels[furthest], training_poses[apart.argmin()])]
        path = folder / f"novelty-{run.name}.png"
        exr.write_png(path, np.concatenate([_portrait(p, run.pictures.shape[2]) for p in pair], axis=1))
        shown.append((path.name, f"{run.name}: frame {furthest} as generated, front and side, and the nearest pose"))
    return Table(
        "Novel poses (UNICA Fig. C f)",
        "Distance in mm (root mean square over the surface) to the nearest training frame, of the frames of a rollout "
        "of the report's script, and of the controller under the same keys with phases that training has not seen.",
        ["", "rollout", "furthest", "controller", "furthest"],
        rows,
        pictures=shown,
    )


def trail(runs: list[Finished], folder: Path) -> Table:
    """UNICA Fig. 5: every third frame of a rollout, composited into one scene."""
    shown = []
    for run in runs:
        frames = _rolled(run.avatar(), gaussians=True)
        cloud = jax.tree.map(lambda x: jnp.asarray(x[::TRAIL].reshape(-1, *x.shape[2:])), frames.gaussians)
        low, high = frames.root.min(0), frames.root.max(0)
        middle, span = (low + high) / 2, float(np.linalg.norm((high - low)[[0, 2]]))
        camera = cameras.look_at(
            (middle[0] + 0.4 * span, 0.6 * span, middle[2] - 1.15 * span),
            (middle[0], 0.5, middle[2]),
            width=1280,
            height=640,
            fov_y=0.55,
        )
        out = render(cloud, camera, config=SplatConfig(capacity=int(1.1 * required_capacity(cloud, camera))))
        path = folder / f"trail-{run.name}.png"
        exr.write_png(path, _bytes(out.image + (1 - out.alpha)[..., None] * pictures.ground(camera)))
        shown.append((path.name, f"{run.name}: every third frame of 60 W, 60 S, 60 A, 20 idle"))
    caption = "One scene of all Gaussians; nothing moved by hand."
    return Table("Trails (UNICA Fig. 5)", caption, [], [], pictures=shown)


def strips(runs: list[Finished], folder: Path) -> Table:
    """UNICA Figs. I to L: consecutive frames with the key of each, of a start, two turns and a stop."""
    shown = []
    changes = [k for k in range(len(SCRIPT)) if k == 0 or SCRIPT[k] != SCRIPT[k - 1]]
    for run in runs:
        frames = _rolled(run.avatar(), gaussians=True)
        for change in changes:
            begin = max(0, change - 2)
            part = jax.tree.map(lambda x, b=begin: jnp.asarray(x[b : b + STRIP]), (frames.gaussians, frames.root))
            keys = [ACTIONS[key] for key in SCRIPT[begin : begin + STRIP]]
            event = f"{ACTIONS[SCRIPT[change - 1]] if change else 'standing'} to {ACTIONS[SCRIPT[change]]}"
            views = pictures.draw_frames(*part, run.pictures.shape[2], label=event)
            path = folder / f"keys-{run.name}-{event.replace(' ', '-')}.png"
            # The left side shows running forward best.
            pictures.save_grid(path, [v[1] for v in views], keys, columns=STRIP // 2)
            shown.append((path.name, f"{run.name}, {event}: consecutive frames with the key that made each"))
    caption = "Consecutive frames under the keys that drive to them, left to right, top to bottom; a new key is bold."
    return Table("Keys and frames (UNICA Figs. I to L)", caption, [], [], pictures=shown)


def _rolled(avatar: unica.Avatar, *, gaussians: bool = False) -> unica.Frame:
    """The report's script from standing, on the host."""
    roll = jax.jit(unica.rollout, static_argnames="gaussians")
    state, parts = unica.reset(avatar, jax.random.key(0)), []
    for start in range(0, len(SCRIPT), 50):
        state, frames = roll(avatar, state, jnp.asarray(SCRIPT[start : start + 50]), gaussians=gaussians)
        parts.append(jax.device_get(frames))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def _portrait(cloud: Gaussians, size: int) -> np.ndarray:
    """Front and left side of a cloud about the origin, over grey."""
    views = image_quality.cardinal_cameras(size)
    raised = cloud.replace(means=cloud.means.at[:, 1].add(-cloud.means[:, 1].min()))
    pair = []
    for k in (0, 1):
        camera = jax.tree.map(lambda x, k=k: x[k], views)
        config = SplatConfig(capacity=int(1.1 * required_capacity(raised, camera)))
        out = render(raised, camera, config=config)
        pair.append(_bytes(out.image + (1 - out.alpha)[..., None] * pictures.SKY))
    return np.concatenate(pair, axis=1)


def _bytes(picture: typing.Any) -> np.ndarray:
    return np.asarray(jnp.round(255 * jnp.clip(picture, 0, 1)), np.uint8)
