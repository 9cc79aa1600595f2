"""Tables 1, 3 and I of SMAD: what the reports of runs from one video say of pictures of new motions and new views."""

from __future__ import annotations

import json
import typing
from pathlib import Path

import numpy as np

from avatarjax.metrics import published
from avatarjax.metrics.statistics import Estimate, bootstrap, paired_t_test
from experiments.tables.table import Table, ordering

OURS, METHODS = "ours", ("ours", "equilibrium alone", "skinning")
PARTS = {"train": "learned from", "test": "another seed", "unseen": "unseen kind"}
METRICS = ("PSNR", "SSIM", "LPIPS")
VIEWS = {"pictures": "", "novel views": ", new views"}

Measured = dict[str, typing.Any]  # metrics.json of a run


def monocular(folders: list[Path]) -> Table:
    """What runs of experiments.smad measured, avatar by avatar, and the means over avatars beside the paper's."""
    runs = {folder.parent.name: json.loads((folder / "metrics.json").read_text()) for folder in folders}
    parts = [part for part in PARTS if all(takes(run, part) for run in runs.values())]
    columns = [(view, metric) for view in VIEWS for metric in METRICS]
    rows: list[list[typing.Any]] = []
    for name, run in runs.items():
        for part in parts:
            for method in METHODS:
                cells = [pooled(run, part, *where, method) for where in columns]
                rows.append([name, PARTS[part], method, *cells, loose(run, part, method)])
    remarks = []
    for part in parts:
        means = {
            method: [_mean(pooled(run, part, *where, method) for run in runs.values()) for where in columns]
            for method in METHODS
        }
        for method, cells in means.items():
            errors = _mean(loose(run, part, method) for run in runs.values())
            rows.append([f"mean of {len(runs)}", PARTS[part], method, *cells, errors])
        if part == "test":
            remarks += [_order(means, columns, view) for view in VIEWS]
        if len(runs) > 2:
            ours, skinned = (
                [pooled(run, part, "pictures", "PSNR", m).mean for run in runs.values()] for m in (OURS, "skinning")
            )
            p = paired_t_test(np.array(ours), np.array(skinned)).p
            remarks.append(f"{PARTS[part]}: ours against skinning in PSNR, paired t-test over avatars, p = {p:.2g}")
    table = published.SMAD_1C
    for method in (published.SMAD, published.EXAVATAR, published.AVATAR_3DGS):
        printed = [np.mean([table.at((f"S0{k}", method), metric).value for k in range(1, 6)]) for metric in METRICS]
        rows.append([f"mean of 5, {table.source}", "another motion", method, *map(float, printed), *4 * [None]])
    for part, key in (("train", "train"), ("test", "test"), ("unseen", "OOD")):
        printed = [published.SMAD_3.at(key, metric) for metric in METRICS]
        rows.append([published.SMAD_3.source, PARTS[part], published.SMAD, *printed, *4 * [None]])
    hours = published.SMAD_I.at(published.SMAD, "training hours").value
    remarks += [
        f"{name}: {sum(s for stage, s in run['seconds'].items() if stage not in ('film', 'report')):.0f} s of "
        f"training; {run['frames a second']:.0f} frames a second of rollout, Gaussians included, without rendering "
        f"(SMAD Table I: {hours:g} hours, {published.SMAD_I.at(published.SMAD, 'frames a second').value:g})"
        for name, run in runs.items()
    ]
    return Table(
        "From one video (SMAD Tables 1, 3 and I)",
        "Each avatar learned from a slow turn and moving takes of one camera; pictures over black, one frame of five "
        "of each take, rollouts from rest. Skinning is linear blend skinning of the same Gaussians, equilibrium alone "
        "the equilibrium without swing. New views are cameras beside and behind. Loose nodes: mean distance in mm to "
        "where they truly are. The paper's subjects are others: its rows are landmarks.",
        ["avatar", "motion", "method", *(f"{metric}{VIEWS[view]}" for view, metric in columns), "loose nodes, mm"],
        rows,
        remarks,
    )


def takes(run: Measured, part: str) -> list[Measured]:
    """What was measured on the takes of a part."""
    return [found for name, found in run.items() if name.split(" ")[0] == part and isinstance(found, dict)]


def pooled(run: Measured, part: str, view: str, metric: str, method: str) -> Estimate:
    """Of one take what was measured; of several the mean with its interval over takes."""
    return _pool([found[view][method].get(metric) for found in takes(run, part)])


def loose(run: Measured, part: str, method: str) -> Estimate:
    """Errors of loose nodes, pooled in the same way."""
    return _pool([found["nodes"]["loose nodes"][method] for found in takes(run, part)])


def _pool(found: list[Measured | None]) -> Estimate:
    known = [Estimate(**each) for each in found if each is not None]
    if len(known) == 1:
        return known[0]
    return bootstrap([each.mean for each in known]) if known else Estimate(np.nan, np.nan, np.nan, 0)


def _mean(values: typing.Iterable[Estimate]) -> float:
    return float(np.mean([value.mean for value in values]))


def _order(means: dict[str, list[float]], columns: list[tuple[str, str]], view: str) -> str:
    """Is the learned motion ahead of a skinned avatar's, as in the paper of ExAvatar's?"""
    at = columns.index((view, "PSNR"))
    printed = {
        ours: float(np.mean([published.SMAD_1C.at((f"S0{k}", theirs), "PSNR").value for k in range(1, 6)]))
        for ours, theirs in ((OURS, published.SMAD), ("skinning", published.EXAVATAR))
    }
    sentence = ordering("PSNR", printed, {method: means[method][at] for method in printed})[1]
    return f"another seed{VIEWS[view]}, {sentence} (a skinned avatar is ExAvatar there)"
