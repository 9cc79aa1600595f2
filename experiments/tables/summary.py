"""One row a trained avatar: what its own report has measured, nothing measured again."""

from __future__ import annotations

import json
import typing

from avatarjax.metrics import published
from avatarjax.metrics.statistics import Estimate
from experiments.tables.finished import Finished
from experiments.tables.table import Table


def summary(runs: list[Finished]) -> Table:
    """The numbers of every run's metrics.json side by side."""
    measured = [json.loads((run.folder / "metrics.json").read_text()) for run in runs]

    def row(what: str, of: typing.Callable[[dict[str, typing.Any]], typing.Any]) -> list[typing.Any]:
        return [what, *(_cell(of(m)) for m in measured)]

    def stage(text: str, side: str) -> typing.Callable[[dict[str, typing.Any]], typing.Any]:
        return lambda m: next((s[side] for s in m["stages"] if text in s["what"]), None)

    def images(*keys: str) -> typing.Callable[[dict[str, typing.Any]], typing.Any]:
        return lambda m: _at(m["images"], keys)

    def turning(who: str, what: str) -> typing.Callable[[dict[str, typing.Any]], typing.Any]:
        return lambda m: _at(m["turning"], (who, what))

    def paper(column: str) -> list[typing.Any]:
        return [
            f"{column}, UNICA Table C",
            *(published.UNICA_C.at((run.name, published.UNICA), column) for run in runs),
        ]

    next_frame = "next frame, all groups, against constant"
    turns = "next frame, turning groups, against constant"
    rows = [
        row("next frame, mm", stage(next_frame, "ours")),
        row("constant velocity, mm", stage(next_frame, "baseline")),
        row("next frame in turns, mm", stage(turns, "ours")),
        row("constant velocity in turns, mm", stage(turns, "baseline")),
        row("held-out poses, PSNR, dB", images("poses", "texels", "psnr")),
        row("held-out poses, LPIPS", images("poses", "texels", "lpips")),
        row("next frame, PSNR, dB", images("next frame", "psnr")),
        paper("PSNR"),
        row("next frame, LPIPS", images("next frame", "lpips")),
        paper("LPIPS"),
        row("FVD of the rollout, mean of views", images("fvd", "mean of views")),
        row("FVD, views pooled", images("fvd", "pooled")),
        paper("FVD"),
        row("heading error, degrees", turning("rollout", "heading_error")),
        row("controller's", turning("controller", "heading_error")),
        row("frames of a 180 degree turn", turning("rollout", "turn_frames 180")),
        row("controller's", turning("controller", "turn_frames 180")),
        row("frames of a 90 degree turn", turning("rollout", "turn_frames 90")),
        row("controller's", turning("controller", "turn_frames 90")),
        row("foot slide, mm a contact", lambda m: _at(m["foot_slide_mm"], ("rollout", "mean"))),
        row("controller's", lambda m: _at(m["foot_slide_mm"], ("controller", "mean"))),
        row("spiking frames", lambda m: _at(m["joints"], ("spikes", "rollout"))),
        row("controller's", lambda m: _at(m["joints"], ("spikes", "controller"))),
        row("frames of the long rollout", lambda m: m["long_rollout"]["frames"]),
        row("seconds of training", lambda m: sum(v for k, v in m["seconds"].items() if k in _TRAINED)),
    ]
    return Table(
        f"The trained avatars, {runs[0].folder.name}",
        "What the reports of the runs say, each of one training and one rollout; means with 95 % intervals. The "
        "paper's characters, pictures and truth are others: its numbers are landmarks.",
        ["", *(run.name for run in runs)],
        rows,
    )


_TRAINED = ("vae", "unet", "coefficients", "base", "appearance", "texels")


def _at(tree: typing.Any, keys: typing.Sequence[str]) -> typing.Any:
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _cell(value: typing.Any) -> typing.Any:
    """An estimate as Markdown's narrow columns take it: without its n."""
    if isinstance(value, dict):
        value = Estimate(**{k: float("nan") if v is None and k in ("low", "high") else v for k, v in value.items()})
        return f"{value:.3g}".split(" (n")[0]
    return value
