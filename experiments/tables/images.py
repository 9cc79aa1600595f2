"""Tables of image and video quality: the alignment of six views (UNICA Table 3) and sampling steps (Table B)."""

from __future__ import annotations

import typing

from avatarjax import unica
from avatarjax.metrics import published
from avatarjax.metrics.statistics import Estimate
from avatarjax.unica.config import DynamicsName
from experiments.tables.finished import Finished
from experiments.tables.table import BETTER, Notebook, Table, ordering
from experiments.unica_dynamics_measures import SAMPLING_STEPS, with_steps

HOW = (
    "FVD of rollouts of the report's script against the meshes under the same keys (mean of four views; n rollouts "
    "with other noise), PSNR and LPIPS of next frames from three true ones (n pictures in so many poses)."
)


def alignment(runs: list[Finished], notebook: Notebook, rollouts: int) -> Table:
    """UNICA Table 3: the UNet's maps with and without projection on principal components."""
    run = runs[0]
    avatar = run.avatar("unet")
    assert avatar.pca is not None
    found = {
        "without PCA": _judged(run, "unet", "without PCA", avatar.replace(pca=None), notebook, rollouts),
        "with PCA": _judged(run, "unet", "with PCA", avatar, notebook, rollouts),
    }
    return _against_paper(
        f"Alignment of the six views, {run.name}, {run.folder.name} (UNICA Table 3)",
        f"The UNet with {len(avatar.pca.basis)} components. {HOW}",
        found,
        published.UNICA_3,
    )


def steps(runs: list[Finished], notebook: Notebook, rollouts: int, dynamics: DynamicsName) -> Table:
    """UNICA Table B: the number of sampling steps."""
    run = runs[0]
    avatar = run.avatar(dynamics)
    found = {}
    for count in SAMPLING_STEPS:
        found[count] = _judged(run, dynamics, f"{count} steps", with_steps(avatar, count), notebook, rollouts)
    return _against_paper(
        f"Sampling steps of the {dynamics} model, {run.name}, {run.folder.name} (UNICA Table B)",
        HOW,
        found,
        published.UNICA_B,
    )


def _judged(
    run: Finished, dynamics: DynamicsName, what: str, avatar: unica.Avatar, notebook: Notebook, rollouts: int
) -> dict[str, Estimate]:
    return notebook.measured(f"{run.mark(dynamics)}, {what}, {rollouts} rollouts", lambda: run.judge(avatar, rollouts))


def _against_paper(
    title: str, caption: str, found: dict[typing.Any, dict[str, Estimate]], paper: published.PrintedTable
) -> Table:
    rows = [
        [str(name), *(x for metric in BETTER for x in (measured[metric], paper.at(name, metric)))]
        for name, measured in found.items()
    ]
    remarks = []
    for metric in BETTER:
        printed = {name: paper.at(name, metric).value for name in found}
        remarks.append(ordering(metric, printed, {name: measured[metric] for name, measured in found.items()})[1])
    return Table(title, caption, ["", *(c for metric in BETTER for c in (metric, "paper"))], rows, remarks)
