"""The report of a SMAD run: pictures and errors on takes that were not learned from, beside baselines."""

from __future__ import annotations

import json
import typing

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from avatarjax import smad
from avatarjax.data import MonocularVideo, avatars
from avatarjax.gaussians import Gaussians
from avatarjax.io import atomic, exr, video
from avatarjax.metrics import lpips, pretrained
from avatarjax.metrics.report import Report
from avatarjax.smad import driving, dynamics
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import read_metrics
from experiments import pictures
from experiments import smad_measures as measures

if typing.TYPE_CHECKING:
    from experiments.smad import Experiment

LEARNED = 3  # takes that were learned from and are measured: one of each performance
PARTS = {
    "train": "takes that were learned from",
    "test": "other takes of motions that were learned from",
    "unseen": "motions that were not learned from",
}


def write(
    experiment: Experiment,
    avatar: smad.Avatar,
    takes: dict[str, list[MonocularVideo]],
    tracks: list[Take],
    fitted: Gaussians,
) -> None:
    """Measure the avatar on all takes, and write metrics.json, videos, contact sheets and report.html.

    `tracks` are those of the takes that it learned from, and `fitted` the Gaussians before they were learned on: how
    good the fit is that dynamics can only come near to.
    """
    folder = experiment.folder
    perceptual = lpips.load("alex") if pretrained.available("alex") else None
    canonical = takes["train"][0]
    # The first take is the slow turn, in which nothing swings: of what was learned from a few others tell enough.
    shown = takes | {"train": takes["train"][1 : 1 + LEARNED] or takes["train"]}
    truths = {part: [measures.true_nodes(avatar, canonical, take) for take in found] for part, found in shown.items()}
    everywhere = np.arange(len(avatar.system.graph.positions))
    regions = {"all nodes": everywhere}
    if all(truth is not None for truth in truths["train"]):
        known = [truth for truth in truths["train"] if truth is not None]
        regions["loose nodes"] = measures.loose_nodes(
            avatar, known, [driving.recorded(take.poses) for take in shown["train"]]
        )
    texture = None if experiment.args.videos else np.asarray(avatars.build(experiment.args.avatar).texture)
    results: dict[str, typing.Any] = {}
    fits = dict(zip([take.folder for take in takes["train"]], tracks, strict=True))
    measured = [(part, *pair) for part in shown for pair in zip(shown[part], truths[part], strict=True)]
    for part, take, truth in tqdm(measured, desc="measuring", unit="take"):
        moved = measures.move(avatar, driving.recorded(take.poses))
        if take.folder in fits:
            moved["tracks"] = measures.follow(avatar.replace(gaussians=fitted), fits[take.folder])
        name = f"{part} {take.folder.name}"
        recorded = measures.recorded_view(take)
        results[name] = {"pictures": measures.picture_errors([recorded], moved, perceptual)}
        if novel := measures.novel_views(take, texture) if texture is not None else []:
            results[name]["novel views"] = measures.picture_errors(novel, moved, perceptual)
        if truth is not None:
            results[name]["nodes"] = {r: measures.node_errors(truth, moved, c) for r, c in regions.items()}
        if take is shown[part][0] and part != "train":
            film(folder, part, recorded, moved)
    speed = measures.frames_a_second(avatar, driving.recorded(measured[-1][1].poses))
    known = plain(results) | {"seconds": experiment.clock.seconds, "frames a second": speed}
    atomic.write_text(folder / "metrics.json", json.dumps(known, indent=1))
    page(experiment, avatar, results, shown, len(tracks))


def film(folder, part: str, view: measures.View, moved: dict[str, measures.Moved]) -> None:
    """A video and a contact sheet: the recording, ours, skinning, and how far ours is from the recording."""
    rows = []
    for frame in range(1, view.frames):
        camera, truth, _ = view.at(frame)
        ours, skinned = (
            jnp.clip(measures.draw(moved[name].gaussians(frame), camera), 0, 1) for name in ("ours", "skinning")
        )
        error = jnp.abs(ours - truth).mean(-1, keepdims=True).repeat(3, -1)
        panel = jnp.concatenate([truth, ours, skinned, jnp.clip(3 * error, 0, 1)], axis=1)
        rows.append(np.asarray(jnp.round(255 * panel)).astype(np.uint8))
    video.write_video(folder / f"{part}.mp4", rows)
    chosen = np.linspace(measures.SETTLE, len(rows) - 1, 6).round().astype(int)
    sheet = np.concatenate([np.concatenate([rows[k] for k in pair], axis=1) for pair in chosen.reshape(3, 2)])
    exr.write_png(folder / f"{part}.png", sheet)


def page(experiment: Experiment, avatar: smad.Avatar, results, shown, learned: int) -> None:
    """report.html of an avatar that learned from so many takes."""
    args, folder = experiment.args, experiment.folder
    report = Report(f"SMAD: {args.avatar}, preset {args.preset}")
    report.text(
        f"{len(avatar.gaussians)} Gaussians on {len(avatar.system.graph.positions)} nodes, learned from "
        f"{learned} takes of one camera, the first of them a slow turn. Each method drives the same Gaussians: "
        "ours by the learned mass-spring-damper system, the second by what a window of poses alone says, the third by "
        "linear blend skinning; tracks, with Gaussians of their own, are what was fitted to the pictures of a take "
        "itself, which the others learned from and cannot beat by much."
    )
    for part in ("test", "unseen"):
        if shown.get(part):
            report.heading(f"How it moves: {PARTS[part]}")
            caption = f"{shown[part][0].folder.name}: recorded, ours, skinning, three times the error of ours"
            report.media(folder / f"{part}.mp4", caption)
            report.media(folder / f"{part}.png", caption)
    report.heading("Pictures")
    for views, where in (("pictures", "the camera that filmed"), ("novel views", "cameras beside and behind it")):
        measured = {name: found[views] for name, found in results.items() if views in found}
        if measured:
            kinds = list(next(iter(measured.values()))["ours"])
            rows = [[n, m, *(found[m][k] for k in kinds)] for n, found in measured.items() for m in found]
            caption = f"One frame of {measures.EVERY}, over black, from {where}; intervals over frames"
            report.table(caption, ["take", "method", *kinds], rows)
    if any("nodes" in found for found in results.values()):
        report.heading("Geometry")
        report.text(
            "Mean distance of nodes to the vertices of the true mesh that are nearest to them in the canonical pose, "
            f"mm. Loose are the {measures.LOOSE:.0%} of the nodes that are furthest from skinning in training."
        )
        regions = list(next(f["nodes"] for f in results.values() if "nodes" in f))
        rows = [
            [n, m, *(f["nodes"][r][m] for r in regions)]
            for n, f in results.items()
            if "nodes" in f
            for m in f["pictures"]
        ]
        report.table("Errors of nodes, mm", ["take", "method", *regions], rows)
    report.heading("Learning")
    for stage in ("refine", "dynamics_target", "drape", "swing"):
        path = folder / "checkpoints" / f"{stage}.jsonl"
        pictures.plot_losses(path.with_suffix(".png"), read_metrics(path), stage)
        report.media(path.with_suffix(".png"), f"Loss of {stage}")
    _, anchor = dynamics.springs(avatar.params, avatar.system.graph)
    report.plot(
        lambda axes: axes.hist(np.asarray(jnp.sqrt(anchor)) / (2 * np.pi), bins=40),
        "How stiffly nodes are held to the skinned surface: natural frequencies, 1/s, over nodes. Low ones swing.",
    )
    report.environment(
        f"python -m experiments.smad --avatar {args.avatar} --preset {args.preset}", experiment.clock.seconds
    )
    report.write(folder / "report.html")


def plain(results: typing.Any) -> typing.Any:
    """Estimates as dictionaries, for JSON."""
    if isinstance(results, dict):
        return {key: plain(value) for key, value in results.items()}
    return results._asdict() if hasattr(results, "_asdict") else results
