"""Tables 2 and C of UNICA: FVD, PSNR and LPIPS of every avatar, beside baselines that are given the true skeleton."""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax.data import avatars, dataset, skinning
from avatarjax.io import weights
from avatarjax.metrics import lpips, published
from avatarjax.metrics.statistics import Estimate
from avatarjax.train import Run
from avatarjax.unica.baselines import pose_driven, rigging
from experiments.tables.finished import Finished
from experiments.tables.table import BETTER, Notebook, Table, ordering

EXAMPLES = 200  # poses from which skinning weights are solved
OURS, RIGGED, POSED = "UNICA (ours)", "automatic rigging (ours)", "pose-driven 3DGS (ours)"
PAPER = {OURS: published.UNICA, RIGGED: published.MIXAMO, POSED: published.ANIMATABLE}


def quality(runs: list[Finished], notebook: Notebook, rollouts: int, folder: Path) -> Table:
    """UNICA Tables 2 and C; what the baselines train goes below `folder`."""
    methods: dict[str, Callable[[Finished], dict[str, Estimate]]] = {
        POSED: lambda run: run.judge_video(posed_video(run, folder / "baselines" / run.name)),
        RIGGED: lambda run: run.judge_video(rigged_video(run)),
        OURS: lambda run: run.judge(run.avatar(), rollouts),
    }
    found = {}
    for run in runs:
        mark = run.mark(run.avatar().config.dynamics)
        for method, measure in methods.items():
            name = f"{mark}, {method}, {rollouts} rollouts"
            found[run.name, method] = notebook.measured(name, lambda run=run, m=measure: m(run))
    rows: list[list[typing.Any]] = []
    remarks = []
    for run in runs:
        for method in methods:
            measured = found[run.name, method]
            paper = (published.UNICA_C.at((run.name, PAPER[method]), metric) for metric in BETTER)
            rows.append([run.name, method, *_beside(measured, paper)])
        for metric in BETTER:
            printed = {m: published.UNICA_C.at((run.name, PAPER[m]), metric).value for m in methods}
            sentence = ordering(metric, printed, {m: found[run.name, m][metric] for m in methods})[1]
            remarks.append(f"{run.name}, {sentence}")
    for method in methods:
        means = {metric: float(np.mean([found[run.name, method][metric].mean for run in runs])) for metric in BETTER}
        paper = (published.UNICA_2.at(PAPER[method], metric) for metric in BETTER)
        rows.append([f"mean of {len(runs)}", method, *_beside(means, paper)])
    return Table(
        "Quality of every avatar (UNICA Tables 2 and C)",
        "Ours: FVD of rollouts of the report's script against the meshes under the same keys, mean of four cardinal "
        "views (n rollouts); PSNR and LPIPS of next frames from three true ones. Automatic rigging: linear blend "
        f"skinning with weights solved on the simplex from {EXAMPLES} training poses, driven by the true skeleton and "
        "dressed in the avatar's own Gaussians, so that only the geometry differs. Pose-driven 3DGS: the same skinned "
        "surface under a texel head of the same size that may move Gaussians by decimetres, trained on the same "
        "pictures for the same number of steps, at the best of three learning rates. PSNR and LPIPS of both are of the "
        "same frames. The paper's rows are Animatable Gaussians, Mixamo and UNICA. SV4D and the user study are not "
        "reproduced.",
        ["avatar", "method", *(c for metric in BETTER for c in (metric, "paper"))],
        rows,
        remarks,
    )


def _beside(measured: typing.Mapping[str, typing.Any], paper: typing.Iterable[published.Published]) -> list[typing.Any]:
    return [x for metric, printed in zip(BETTER, paper, strict=True) for x in (measured[metric], printed)]


def rigged_video(run: Finished) -> np.ndarray:
    """The surface on its skeleton under the report's script, dressed: (4, f, h, w, 3) uint8."""
    return run.dressed_video(run.avatar(), *rigged_truth(run))


def posed_video(run: Finished, folder: Path) -> np.ndarray:
    """The same surface dressed by the pose-driven baseline, which is trained or found in `folder`."""
    avatar, rig, surface = run.avatar(), avatars.build(run.name).rig, rig_surface(run)
    index = weights.load_arrays(dataset.table_path(run.folder / "data", "train"))[0]
    skinned = np.empty_like(run.data.train_images.texels)
    for clip in np.unique(index["sequence"]):
        rows = np.flatnonzero(index["sequence"] == clip)
        take = dataset.load_take(run.folder / "data", "train", int(clip))
        frames = index["frame"][rows]
        skinned[rows] = rigging.pose(surface, bones(rig, take, frames)) - take.roots[frames][:, None]
    place = Run(folder, 0, dataset.fingerprint(run.folder / "data"))
    parts = run.data, place, avatar.upscaler, avatar.base, skinned, lpips.load(avatar.config.lpips_network)
    params, base = pose_driven.train(avatar.config, *parts)
    worn = avatar.replace(appearance=params, base=base, config=pose_driven.pose_driven(avatar.config))
    return run.dressed_video(worn, *rigged_truth(run))


def rigged_truth(run: Finished) -> tuple[np.ndarray, np.ndarray]:
    """World texels (f, t, 3) that rigging makes of the skeleton of the pictured script, and the true roots (f, 3)."""
    rig = avatars.build(run.name).rig
    surface = rig_surface(run)
    truth = dataset.load_take(run.folder / "data", "truth", 0)
    frames = len(run.pictures)
    posed = rigging.pose(surface, bones(rig, truth, np.arange(frames)))
    return np.asarray(posed), np.asarray(truth.roots[:frames])


@functools.cache
def rig_surface(run: Finished) -> rigging.Rigged:
    """Skinning weights from poses spread over the training data."""
    rig = avatars.build(run.name).rig
    folder, data = run.folder / "data", run.data
    chosen = np.unique(np.linspace(0, len(data.train.texels) - 1, EXAMPLES).astype(int))
    sequence = np.asarray(data.train.sequence)
    parts = []
    for clip in np.unique(sequence[chosen]):
        inside = chosen[sequence[chosen] == clip] - int(np.argmax(sequence == clip))
        parts.append(bones(rig, dataset.load_take(folder, "train", int(clip)), inside))
    world = np.asarray(data.train.texels[chosen] + data.train.roots[chosen][:, None])
    return rigging.fit(data.atlas.reference, np.concatenate(parts), world)


def bones(rig: typing.Any, take: typing.Any, frames: np.ndarray) -> np.ndarray:
    """Transforms (f, j, 3, 4) from the pose of the position maps' reference to recorded frames."""
    posed = jax.vmap(skinning.forward_kinematics, in_axes=(None, 0, 0))(
        rig, jnp.asarray(take.quats[frames]), jnp.asarray(take.hips[frames])
    )
    return np.asarray(rigging.from_reference(avatars.a_pose(rig), posed))
