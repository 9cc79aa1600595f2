"""Print the papers' tables and figures as measured on finished runs, beside the papers' numbers.

    python -m experiments.tables summary                       # what the reports of all trained avatars say
    python -m experiments.tables quality                       # Tables 2 and C: all trained avatars
    python -m experiments.tables steps --avatars cowgirl       # Table B
    python -m experiments.tables alignment --preset ci         # Table 3: needs a run with the UNet
    python -m experiments.tables context --preset ci           # Fig. 8: trains a model for each number of frames
    python -m experiments.tables feed_forward --preset ci      # Fig. D: trains it for as many steps as the run's UNet
    python -m experiments.tables resolution --preset ci        # Fig. E: trains appearance for four pairs of sides
    python -m experiments.tables times                         # Table D
    python -m experiments.tables sliding                       # Fig. 6: 2,000 frames, minutes an avatar
    python -m experiments.tables components novelty trail strips   # Figs. B, C (f), 5, I to L
    python -m experiments.tables monocular --preset ci         # SMAD's Tables 1, 3 and I
    python -m experiments.tables initialisation --preset ci --avatars cowgirl    # SMAD's Fig. 6, right; minutes
    python -m experiments.tables deformers long_takes --preset ci --avatars cowgirl    # SMAD's Tables 2, 4, 5; an hour
    python -m experiments.tables deformers --preset ci --methods MLP "A1 + losses"         # some of their rows
    python -m experiments.tables fusion --preset ci --avatars cowgirl     # SMAD's feature fusion: five ways, minutes

Runs are those of `python -m experiments.unica --avatar NAME --train` under OUT/unica/NAME/PRESET, and for SMAD's tables
those of `python -m experiments.smad --avatar NAME` under OUT/smad/NAME/PRESET; `initialisation` needs no more than
their stage `film`. Results go to OUT/tables/PRESET/: NAME.md with its pictures, and what was measured in cells.json, so
that an interrupted table goes on. SV4D and the user study of UNICA are not reproduced; SMAD's Tables 2 to 5, J and K in
millimetres, and its Figs. 6, 7, I and J: experiments.smad_dynamics.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable
from pathlib import Path

import tyro

from avatarjax.data import avatars as known
from avatarjax.io import atomic
from avatarjax.metrics import environment
from avatarjax.unica.config import DynamicsName, PresetName
from experiments import command_line
from experiments.tables import (
    context,
    deformers,
    feed_forward,
    figures,
    fusion,
    images,
    initialisation,
    long,
    monocular,
    quality,
    resolution,
    summary,
)
from experiments.tables.finished import Finished
from experiments.tables.table import Notebook, Table

Name = typing.Literal[
    "summary",
    "quality",
    "alignment",
    "steps",
    "context",
    "feed_forward",
    "resolution",
    "times",
    "sliding",
    "components",
    "novelty",
    "trail",
    "strips",
    "monocular",
    "initialisation",
    "deformers",
    "long_takes",
    "fusion",
]

# Tables of finished runs of experiments.smad.
OF_VIDEOS = {"monocular", "deformers", "long_takes", "fusion"}


@dataclasses.dataclass
class Args:
    """Which tables, of which runs."""

    names: tyro.conf.Positional[tuple[Name, ...]]
    """Tables to measure, in this order."""
    preset: PresetName = "small"
    """Of the runs."""
    avatars: tuple[str, ...] = ()
    """Of the runs; default: all that are finished."""
    dynamics: DynamicsName = "coefficients"
    """The model whose sampling steps and context `steps` and `context` vary."""
    methods: tuple[str, ...] = ()
    """Rows of `deformers` beside ours, each minutes of training; default: all."""
    rollouts: int = 3
    """Rollouts behind each FVD of `quality`, `alignment` and `steps`."""
    out: Path = Path("runs")
    """Where the runs are, and where the tables go."""


def run_tables(args: Args) -> list[Table]:
    """Measure, print and write the tables. Raises ValueError where there is no finished run."""
    names = set(args.names)
    videos = folders(args, "smad", "--avatar {}") if names & OF_VIDEOS else []
    films = (
        folders(args, "smad", "--stage film --avatar {}", initialisation.filmed) if "initialisation" in names else []
    )
    others = names - OF_VIDEOS - {"initialisation"}
    runs = [Finished(f) for f in folders(args, "unica", "--avatar {} --train")] if others else []
    folder = args.out / "tables" / args.preset
    folder.mkdir(parents=True, exist_ok=True)
    notebook = Notebook(folder / "cells.json")
    makers: dict[str, Callable[[], Table]] = {
        "summary": lambda: summary.summary(runs),
        "quality": lambda: quality.quality(runs, notebook, args.rollouts, folder),
        "alignment": lambda: images.alignment(runs, notebook, args.rollouts),
        "steps": lambda: images.steps(runs, notebook, args.rollouts, args.dynamics),
        "context": lambda: context.context(runs, notebook, folder, args.dynamics),
        "feed_forward": lambda: feed_forward.feed_forward(runs, notebook, folder),
        "resolution": lambda: resolution.resolution(runs, notebook, folder),
        "times": lambda: long.times(runs, notebook),
        "sliding": lambda: long.sliding(runs, notebook, folder),
        "components": lambda: figures.components(runs, notebook, folder),
        "novelty": lambda: figures.novelty(runs, folder),
        "trail": lambda: figures.trail(runs, folder),
        "strips": lambda: figures.strips(runs, folder),
        "monocular": lambda: monocular.monocular(videos),
        "initialisation": lambda: initialisation.initialisation(films, notebook, folder),
        "deformers": lambda: deformers.deformers(videos, notebook, folder, args.methods),
        "fusion": lambda: fusion.fusion(videos, notebook, folder),
        "long_takes": lambda: deformers.long_takes(videos, notebook, folder),
    }
    made = []
    for name in args.names:
        table = makers[name]()
        made_on = ", ".join(f"{key} {value}" for key, value in environment.describe().items())
        text = f"{table.markdown()}\n`python -m experiments.tables {name} --preset {args.preset}` on {made_on}.\n"
        atomic.write_text(folder / f"{name}.md", text)
        print(f"\n{text}\nwritten to {folder / name}.md", flush=True)
        made.append(table)
    return made


def measured(folder: Path) -> bool:
    """Whether a run is finished."""
    return (folder / "metrics.json").is_file()


def folders(args: Args, system: str, options: str, done: Callable[[Path], bool] = measured) -> list[Path]:
    """The folders of the runs of a system that `args` ask for and that are done, in the order of the avatars' names;
    `options` make such a run. Raises ValueError where there is none."""
    all_of_them = [args.out / system / name / args.preset for name in args.avatars or known.names()]
    there = [f for f in all_of_them if done(f)]
    missing = [f.parent.name for f in all_of_them if f not in there]
    if not there or (args.avatars and missing):
        raise ValueError(
            f"no finished run of {', '.join(missing)} under {args.out / system}: make it with "
            f"python -m experiments.{system} {options.format(missing[0])} --preset {args.preset}"
        )
    return there


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(run_tables, Args, "experiments.tables", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
