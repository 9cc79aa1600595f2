"""What confidence-aware feature fusion is worth (SMAD's introduction, Table F): colours by what other frames show."""

from __future__ import annotations

import functools
import itertools
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import smad
from avatarjax.data import MonocularVideo, avatars
from avatarjax.gaussians import Gaussians
from avatarjax.smad import driving, footage, train_pictures
from avatarjax.smad import fusion as fusing
from avatarjax.smad.fusion import FusionConfig
from experiments import smad_measures as measures
from experiments.tables.deformers import Values, Workshop, less, perceptual, pooled
from experiments.tables.table import Notebook, Table

OWN = "its own"
METHODS = {
    OWN: FusionConfig(views=0),
    "confidence and attention": FusionConfig(),
    "confidence alone": FusionConfig(attention=False),
    "attention alone": FusionConfig(confidence=False),
    "confidence and attention, rho 0.2": FusionConfig(rho=0.2),
}
PARTS = {"test": "another seed", "unseen": "unseen kind"}
RECORDED, NOVEL = "recorded view", "new views"


def fusion(folders: list[Path], notebook: Notebook, folder: Path) -> Table:
    """Every way to colour the Gaussians of a run, learned for the same steps; checkpoints go below `folder`."""
    rows: list[list[typing.Any]] = []
    for run in folders:
        shop = Workshop(run, folder / "fusion" / run.parent.name)
        found = {m: notebook.measured(f"{shop.name}, {m}", functools.partial(_measured, shop, m)) for m in METHODS}
        for part, view in itertools.product(PARTS, (RECORDED, NOVEL)):
            if not found[OWN][part][view]:
                continue
            for method in METHODS:
                takes, own = found[method][part][view], found[OWN][part][view]
                cells = [pooled(takes, metric) for metric in ("PSNR", "SSIM", "LPIPS")]
                rows.append([run.parent.name, PARTS[part], view, method, *cells, less(takes, own, "PSNR")])
    return Table(
        "Confidence-aware feature fusion (SMAD's introduction and Table F)",
        "Colours of the Gaussians of finished runs, learned on from their takes for the same steps at their "
        "equilibrium: their own alone, or beside them what frames of the slow turn show. Rollouts from rest, one frame "
        "of five over black; intervals are over pieces of a second. The last column is PSNR less that of own colours, "
        "frame by frame. The paper prints no ablation of it.",
        ["avatar", "motion", "view", "colours", "PSNR", "SSIM", "LPIPS", "more than its own"],
        rows,
    )


def _measured(shop: Workshop, method: str) -> dict[str, dict[str, list[Values]]]:
    """By part and view what the pictures of each take are like."""
    config, run = METHODS[method], shop.run(shop.place / method.replace(" ", "-"))
    takes = footage.gather(shop.takes["train"])
    avatar, learned = train_pictures.train_fusion(smad.load(shop.folder), takes, config, run)
    texture = np.asarray(avatars.build(shop.folder.parent.name).texture)
    found: dict[str, dict[str, list[Values]]] = {}
    for part in PARTS:
        found[part] = {RECORDED: [], NOVEL: []}
        for take in shop.shown(part):
            moved = measures.move(avatar, driving.recorded(take.poses))["ours"]
            views = {RECORDED: [measures.recorded_view(take)], NOVEL: measures.novel_views(take, texture)}
            for name, several in views.items():
                each = [_values(config, learned, moved, take, view) for view in several]
                # The views of one frame count together.
                means = {metric: np.mean([values[metric] for values in each], axis=0).tolist() for metric in each[0]}
                found[part][name].append(means)
    return found


def _values(config, learned, moved: measures.Moved, take: MonocularVideo, view: measures.View) -> Values:
    """Of each measured frame of a view."""
    poses = driving.recorded(take.poses)

    def seen(frame: int) -> Gaussians:
        if learned is None:
            return moved.gaussians(frame)
        pose = jax.tree.map(lambda x: x[frame], poses)
        place = driving.to_body(pose, view.at(frame)[0].position[None])[0]
        return _fuse(config, *learned, moved.gaussians(frame), place / jnp.linalg.norm(place))

    return measures.picture_values([view], {OWN: measures.Moved(seen, moved.nodes)}, perceptual())[OWN]


@functools.partial(jax.jit, static_argnames="config")
def _fuse(config, params, views, gaussians, towards):
    return fusing.fuse(config, params, views, gaussians, towards)
