"""Learn an avatar whose clothes swing from videos of one camera, animate it with poses, and report: SMAD end to end.

    python -m experiments.smad --avatar ghostlady                 # preset small, the default on a CPU
    python -m experiments.smad --avatar ghostlady --preset ci     # the same at the smallest sizes, in minutes
    python -m experiments.smad --videos my_turn my_walk --test my_dance    # your own takes (docs/data_import.md)
    python -m experiments.smad --avatar ghostlady --stage dynamics         # one stage anew

Stages in order: film, hull, refine, dynamics, report. The first take shows the person turning slowly before the camera.
Results lie in OUT/smad/AVATAR/PRESET/; open report.html there. A second run reuses what is finished, an interrupted one
goes on.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import shutil
import time
import typing
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from avatarjax import smad
from avatarjax.data import MonocularVideo, avatars, capture, load_monocular
from avatarjax.gaussians import Gaussians
from avatarjax.io import atomic
from avatarjax.physics.xpbd import XPBDConfig
from avatarjax.smad import (
    driving,
    dynamics,
    files,
    footage,
    graph,
    hull,
    refine,
    skeletal,
    train_dynamics,
    train_pictures,
)
from avatarjax.smad.config import FilmConfig, SmadConfig
from avatarjax.smad.refine import Refined
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run
from experiments import command_line, smad_motions, smad_report
from experiments.clock import Clock
from experiments.smad_motions import Name

STAGES = ("film", "hull", "refine", "dynamics", "report")
TRAINED = {"refine": ("refine",), "dynamics": ("dynamics_target", "drape", "swing")}


@dataclasses.dataclass
class Args:
    """Learn an avatar with swinging clothes from monocular videos and report how it moves."""

    avatar: str = "ghostlady"
    """Which avatar to film: monk, cowgirl, survival, berserker or ghostlady."""
    videos: tuple[Path, ...] = ()
    """Learn from your own takes instead: folders that avatarjax.data.load_monocular reads, the slow turn first."""
    test: tuple[Path, ...] = ()
    """Takes of the same person to measure on, with --videos."""
    preset: str = ""
    """Sizes: ci, small, base or paper. Without it, small on a CPU and base on an accelerator."""
    stage: str = "all"
    """Run only this stage, anew; stages before it are reused, or run where they are missing."""
    resume: bool = True
    """Go on from checkpoints. --no-resume deletes this run's results first."""
    seed: int = 0
    """Seed of training; results of seeds other than 0 go to a folder PRESET-seedN."""
    out: Path = Path("runs")
    """Folder under which results go, as OUT/smad/AVATAR/PRESET/."""


@dataclasses.dataclass
class Experiment:
    """One run: its arguments, configuration and folder."""

    args: Args
    config: SmadConfig
    folder: Path

    @functools.cached_property
    def clock(self) -> Clock:
        """How long its stages took."""
        return Clock(self.folder / "seconds.json")


def run_experiment(args: Args) -> Path:
    """Run the stages that `args` ask for; returns the folder of the results."""
    experiment = prepare(args)
    folder, config = experiment.folder, experiment.config
    last = STAGES.index("report" if args.stage == "all" else args.stage)
    began = time.monotonic()

    def stage(name: str, text: str, work: Callable[[], typing.Any]) -> typing.Any:
        print(f"[{time.monotonic() - began:6.1f} s] {name}: {text}", flush=True)
        return experiment.clock.run(name, work)

    print(f"avatar {args.avatar}, preset {args.preset}, into {folder}")
    takes = stage("film", "takes to learn from and to measure on", lambda: film(experiment))
    if last == 0:
        return folder
    start = stage("hull", "the first take's silhouettes", lambda: hull.initialise(takes["train"][0], config.hull))
    if last == 1:
        return folder
    run = Run(folder / "checkpoints", args.seed, fingerprint(takes["train"]))
    refined = stage("refine", "Gaussians and tracks", lambda: refined_gaussians(config, takes["train"], start, run))
    if last == 2:
        return folder
    avatar, tracks = stage("dynamics", "training", lambda: learn(config, takes["train"], refined, run))
    files.save(folder / files.FILE, avatar)
    if last == len(STAGES) - 1:
        parts = experiment, avatar, takes, tracks, refined[0].gaussians
        stage("report", "measuring on other takes", lambda: smad_report.write(*parts))
        print(f"[{time.monotonic() - began:6.1f} s] report: open {folder / 'report.html'}")
    return folder


def prepare(args: Args) -> Experiment:
    """Check the arguments and make the run's folder; ValueError says what is wrong and what there is."""
    if args.videos:
        args.avatar = args.videos[0].stem
    elif args.test:
        raise ValueError("--test needs --videos: takes of an avatar of ours are chosen by the preset")
    elif args.avatar not in avatars.names():
        raise ValueError(f"unknown avatar {args.avatar!r}: choose one of {', '.join(avatars.names())}")
    if args.stage not in ("all", *STAGES):
        raise ValueError(f"unknown stage {args.stage!r}: choose one of all, {', '.join(STAGES)}")
    args.preset = args.preset or ("small" if jax.default_backend() == "cpu" else "base")
    config = smad.preset(args.preset)
    name = args.preset if args.seed == 0 else f"{args.preset}-seed{args.seed}"
    experiment = Experiment(args, config, args.out / "smad" / args.avatar / name)
    if not args.resume and experiment.folder.exists():
        print(f"deleting the earlier results in {experiment.folder}")
        shutil.rmtree(experiment.folder)
    (experiment.folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    if args.stage == "film":
        shutil.rmtree(experiment.folder / "film", ignore_errors=True)
    for stage in TRAINED.get(args.stage, ()):
        for path in (experiment.folder / "checkpoints").glob(f"{stage}*"):
            path.unlink()
    atomic.write_text(experiment.folder / "config.json", json.dumps(dataclasses.asdict(config), indent=2))
    return experiment


def film(experiment: Experiment) -> dict[str, list[MonocularVideo]]:
    """The takes of each part, `train`, `test` and `unseen`: filmed where they are not there yet, or the user's own."""
    args, wanted = experiment.args, experiment.config.film
    if args.videos:
        return {
            "train": [load_monocular(path).held() for path in args.videos],
            "test": [load_monocular(path).held() for path in args.test],
        }
    named = {part: getattr(wanted, part) for part in ("train", "test", "unseen")}
    found = filmed(experiment.folder / "film", args.avatar, [name for each in named.values() for name in each], wanted)
    return {part: [found[name] for name in names] for part, names in named.items()}


def filmed(folder: Path, avatar: str, names: Sequence[Name], wanted: FilmConfig) -> dict[Name, MonocularVideo]:
    """Takes of an avatar of ours in these motions, each in a folder of its own below one, filmed where it is not there
    yet, or in other settings."""
    mesh = functools.cache(lambda: avatars.build(avatar))
    takes = {n: capture.Take(folder / f"{n[0]}-{n[1]}", lambda n=n: smad_motions.perform(mesh().rig, n)) for n in names}
    settings = {"size": wanted.size, "config": XPBDConfig(substeps=wanted.substeps)}
    missing = capture.missing(list(takes.values()), **settings)
    # Each frame is simulated, then drawn.
    frames = 2 * sum(smad_motions.length(name) for name, take in takes.items() if take in missing)
    with tqdm(total=frames, desc="filming", unit="frame", disable=not missing) as bar:
        if missing:
            capture.film(missing, mesh(), **settings, progress=bar.update)
    return {name: load_monocular(take.folder).held() for name, take in takes.items()}


def fingerprint(takes: Sequence[MonocularVideo]) -> str:
    """What tells these takes from others."""
    mark = hashlib.sha256()
    for take in takes:
        mark.update(np.ascontiguousarray(take.mattes))
        mark.update(np.ascontiguousarray(take.poses.rotations))
        mark.update(np.ascontiguousarray(take.images()[::10]))
    return mark.hexdigest()[:12]


def refined_gaussians(
    config: SmadConfig, takes: Sequence[MonocularVideo], start: Gaussians, run: Run
) -> tuple[Refined, footage.Footage]:
    """Canonical Gaussians and their tracks, fitted to the takes by splatting."""
    shots = footage.gather(takes)
    parts = shots, start, graph.of_gaussians(start, config.graph), shots.pose(0, 0), config.refine
    return refine.refine(*parts, run.folder, run.key("refine")), shots


def learn(
    config: SmadConfig, takes: Sequence[MonocularVideo], refined: tuple[Refined, footage.Footage], run: Run
) -> tuple[smad.Avatar, list[Take]]:
    """The avatar with dynamics that were learned from the tracks of its nodes, and these."""
    avatar, tracks = settle(config, takes, refined, run)
    return train_pictures.train_swing(avatar, refined[1], run), tracks


def settle(
    config: SmadConfig, takes: Sequence[MonocularVideo], refined: tuple[Refined, footage.Footage], run: Run
) -> tuple[smad.Avatar, list[Take]]:
    """The avatar before it has learned to swing: with the equilibrium and the look alone."""
    fitted, shots = refined
    config = dynamics.sized(config, takes[0].poses.rotations.shape[1])
    net, skin = fitted.warp.graph, None
    if shots.rig is not None:
        skin = skeletal.bind(shots.rig, shots.pose(0, 0), net.positions)
    tracks = [Take(driving.recorded(take.poses), refine.tracks(fitted, k)) for k, take in enumerate(takes)]
    # No drape: it would carry the tracks' errors on, which are a camera's, and pictures could not mend it.
    without = dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, components=0))
    system = train_dynamics.fit_system(without, net, skin, tracks)
    # Tracks of one camera are mostly what it does not see: pictures have the last word on all that they began.
    params = train_dynamics.train_target(config, system, train_dynamics.record(config, system, tracks), run)
    avatar = smad.Avatar(fitted.gaussians, fitted.warp.binding, system, params, config)
    return train_pictures.train_drape(avatar, shots, run), tracks


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(run_experiment, Args, "experiments.smad", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
