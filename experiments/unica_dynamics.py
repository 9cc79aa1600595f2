"""Train dynamics models for equal wall time on the same data and compare them: the paper's UNet and the coefficients.

    python -m experiments.unica_dynamics --avatar cowgirl --preset ci --seeds 3 --seconds 120
    python -m experiments.unica_dynamics --preset ci --scripts transitions --models unet-paper   # the paper's own keys
    python -m experiments.unica_dynamics --preset ci --models unet-turned --seconds 600 --seeds 1

Models: `coefficients` (ours), `unet-paper` (UNICA's recipe to the letter), `unet` (the preset's), `unet-turned` (the
preset's, trained on groups turned by quarters as well). A model's number of steps follows from how long a step takes,
compilation left out; the UNet shares its seconds with its autoencoder. On a CPU, seconds are those of all cores
together, so that a comparison stays fair on a machine that does other things as well. Results lie in
OUT/unica_dynamics/AVATAR/PRESET-SCRIPTS/SECONDSs/: dynamics.json, dynamics.md and plots. A second run reuses what is
finished, an interrupted one goes on.
"""

from __future__ import annotations

import dataclasses
import json
import os
import typing
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from avatarjax import unica
from avatarjax.data import avatars, building, dataset
from avatarjax.data.dataset import Dataset
from avatarjax.io import atomic
from avatarjax.metrics.statistics import bootstrap
from avatarjax.train import read_metrics
from avatarjax.unica import train
from avatarjax.unica.config import UnicaConfig
from experiments import command_line, pictures
from experiments import unica as main_run
from experiments import unica_dynamics_measures as measures

ModelName = typing.Literal["coefficients", "unet-paper", "unet", "unet-turned"]
Results = dict[str, list[dict[str, typing.Any]]]  # measures of each model, a seed each
Cell = Callable[[list[dict[str, typing.Any]]], str]
VAE_SHARE = 0.4  # of a UNet's seconds go to its autoencoder
PROBE = 40  # steps that are timed


@dataclasses.dataclass
class Args:
    """Train dynamics models for equal wall time on the same data, and compare them on held-out data."""

    avatar: str = "cowgirl"
    """Which avatar: monk, cowgirl, survival, berserker or ghostlady."""
    preset: str = "ci"
    """Sizes: ci, small, base or paper."""
    scripts: typing.Literal["chains", "transitions"] = "chains"
    """Keys of the training data: chains turn several times as often as the paper's transitions."""
    models: tuple[ModelName, ...] = typing.get_args(ModelName)
    """Which models are trained and measured."""
    seeds: int = 3
    """How many seeds of training and rollout; the data are the same for all."""
    seconds: float = 120.0
    """Training time of each model and seed."""
    frames: int = 600
    """Length of the long rollout."""
    out: Path = Path("runs")
    """Folder under which results go."""


def run(args: Args) -> Path:
    """Train and measure what is missing, then write the comparison; returns the folder of the results."""
    if args.avatar not in avatars.names():
        raise ValueError(f"unknown avatar {args.avatar!r}: choose one of {', '.join(avatars.names())}")
    if args.seeds < 1 or args.seconds <= 0 or not args.models:
        raise ValueError("a comparison needs at least one model, one seed and some seconds")
    config = unica.preset(args.preset)
    config = dataclasses.replace(config, data=dataclasses.replace(config.data, scripts=args.scripts))
    home = args.out / "unica_dynamics" / args.avatar / f"{args.preset}-{args.scripts}"
    data = prepare_data(args, config, home)
    folder = home / f"{args.seconds:g}s"
    folder.mkdir(parents=True, exist_ok=True)
    mark = dataset.fingerprint(home / "data")
    configs = {name: timed_config(args, variant(config, name), data, folder, mark) for name in args.models}
    results: Results = {name: [] for name in args.models}
    for seed in range(args.seeds):
        for name in args.models:
            print(f"{name}, seed {seed}", flush=True)
            results[name].append(one(args, name, configs[name], data, folder, mark, seed))
        report(args, results, measures.controller(data, config.actions), folder)
    return folder


def variant(config: UnicaConfig, name: str) -> UnicaConfig:
    """A preset's configuration as the model of this name has it."""
    if name == "coefficients":
        return dataclasses.replace(config, dynamics="coefficients")
    latent = config.latent
    if name == "unet-paper":
        vae = dataclasses.replace(latent.vae, positions=0)
        latent = dataclasses.replace(latent, vae=vae, from_last=False, min_snr=0.0)
    return dataclasses.replace(config, dynamics="unet", latent=latent, rotate=name == "unet-turned")


def prepare_data(args: Args, config: UnicaConfig, home: Path) -> Dataset:
    """The dataset of this comparison, built where it is missing."""
    asked = main_run.Args(avatar=args.avatar, preset=args.preset)
    spec = main_run.Experiment(asked, config, home).spec()
    if not dataset.matches(home / "data", spec):
        building.build(home / "data", spec)
    return dataset.load(home / "data")


def stages(config: UnicaConfig) -> dict[str, float]:
    """The trained stages of a model, and each one's share of its seconds."""
    return {"vae": VAE_SHARE, "unet": 1 - VAE_SHARE} if config.dynamics == "unet" else {"coefficients": 1.0}


def with_counts(config: UnicaConfig, counts: dict[str, int]) -> UnicaConfig:
    """The configuration with other numbers of steps, by stage."""
    changed = {f"{s}_stage": dataclasses.replace(getattr(config, f"{s}_stage"), steps=n) for s, n in counts.items()}
    return dataclasses.replace(config, **changed)


def train_dynamics(config: UnicaConfig, data: Dataset, run: train.Run) -> typing.Any:
    """Train the model that the configuration names."""
    if config.dynamics == "coefficients":
        return train.train_coefficients(config, data, run)
    untrained = train.new_latent_dynamics(config, data, run)
    return train.train_unet(config, data, run, train.train_vae(config, data, run, untrained))


def timed_config(args: Args, config: UnicaConfig, data: Dataset, folder: Path, mark: str) -> UnicaConfig:
    """The configuration with as many steps as fit into the seconds.

    Measured once for each kind of dynamics, then kept: all seeds, and all UNets, take the same number of steps.
    """
    path, name = folder / "steps.json", config.dynamics
    known = json.loads(path.read_text()) if path.is_file() else {}
    if name not in known:
        probe = train.Run(folder / f"probe-{name}", 0, mark)
        train_dynamics(with_counts(config, dict.fromkeys(stages(config), PROBE)), data, probe)
        # The median leaves compilation out.
        step = {s: float(np.median(intervals(probe.folder / f"{s}.jsonl"))) for s in stages(config)}
        known[name] = {s: max(1, round(args.seconds * share / step[s])) for s, share in stages(config).items()}
        atomic.write_text(path, json.dumps(known, indent=2))
    print(f"{name}: steps {known[name]}", flush=True)
    return with_counts(config, known[name])


def intervals(path: Path) -> np.ndarray:
    """Seconds between the records of a stage: on a CPU those of the processor, divided by the number of cores.

    So what else runs on the machine does not count, and an idle machine would take about as long.
    """
    on_cpu = jax.default_backend() == "cpu"
    clock, cores = ("processor_seconds", os.cpu_count() or 1) if on_cpu else ("seconds", 1)
    ticks = np.diff([r[clock] for r in read_metrics(path)]) / cores
    # The clock starts anew where an interrupted run went on.
    return ticks[ticks > 0]


def one(
    args: Args, name: str, config: UnicaConfig, data: Dataset, folder: Path, mark: str, seed: int
) -> dict[str, typing.Any]:
    """Train and measure one model with one seed, or read back what was measured before."""
    place = folder / name / f"seed{seed}"
    path = place / "measures.json"
    if path.is_file():
        return json.loads(path.read_text())
    run = train.Run(place, seed, mark)
    dynamics = jax.block_until_ready(train_dynamics(config, data, run))
    found: dict[str, typing.Any] = {"steps": {}, "seconds": {}, "load": os.getloadavg()[1]}
    for stage in stages(config):
        records = read_metrics(place / f"{stage}.jsonl")
        found["steps"][stage] = records[-1]["step"]
        found["seconds"][stage] = round(float(intervals(place / f"{stage}.jsonl").sum()), 1)
        pictures.plot_losses(place / f"{stage}.png", records, stage)
    found |= measures.measure(moving(config, data, dynamics), data, seed, args.frames)
    atomic.write_text(path, json.dumps(found))
    return found


def moving(config: UnicaConfig, data: Dataset, dynamics: typing.Any) -> unica.Avatar:
    """An avatar that moves and has nothing to wear."""
    parts = ("upscaler", "tangents", "pca", "base", "appearance")
    nothing: dict[str, typing.Any] = dict.fromkeys(parts)
    return unica.Avatar(atlas=data.atlas, dynamics=dynamics, standing=data.standing, config=config, **nothing)


def report(args: Args, results: Results, controller: dict[str, typing.Any], folder: Path) -> None:
    """Write dynamics.json, dynamics.md and plots, and print the table."""
    text = table(args, results, controller)
    arguments = {k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(args).items()}
    whole = {"arguments": arguments, "controller": controller, "models": results}
    atomic.write_text(folder / "dynamics.json", json.dumps(whole, indent=1))
    atomic.write_text(folder / "dynamics.md", text)
    print(text)

    def curve(runs: list[dict[str, typing.Any]], of: Callable[[dict[str, typing.Any]], list[typing.Any]]) -> np.ndarray:
        return np.mean([np.array(of(r), np.float64) for r in runs], axis=0)

    steps = {
        name: np.stack([measures.SAMPLING_STEPS, curve(runs, lambda r: list(r["sampling_steps"].values()))], -1)
        for name, runs in results.items()
    }
    apart = {name: curve(runs, lambda r: r["diversity"]["pose"]) for name, runs in results.items()}
    rolled = {name: runs[0]["rollout"].get("path") for name, runs in results.items()}
    paths = {name: np.array(path) for name, path in rolled.items() if path}
    pictures.plot_lines(folder / "sampling_steps.png", steps, "sampling steps", "error of the next frame, mm")
    pictures.plot_lines(folder / "diversity.png", apart, "frame", "distance between rollouts of the same keys, mm")
    pictures.plot_paths(folder / "path.png", paths)


def table(args: Args, results: Results, controller: dict[str, typing.Any]) -> str:
    """The comparison as Markdown: a row a measure, a column a model."""

    def row(what: str, cell: Cell, beside: str = "") -> list[str]:
        return [what, *(cell(runs) for runs in results.values()), beside]

    def seeds(*keys: str, digits: str = ".3g") -> Cell:
        return lambda runs: across([pick(r, keys) for r in runs], digits)

    def error(of: str, turning: bool) -> Cell:
        return lambda runs: next_frame(runs, of, turning)

    def truth(name: str, digits: str = ".3g") -> str:
        return "" if controller[name] is None else f"{controller[name]:{digits}}"

    first = next(iter(results.values()))
    obeyed = f"keys obeyed, within {measures.OBEYED_DEGREES:g} degrees"
    rows = [
        row("steps", lambda runs: " + ".join(str(n) for n in runs[0]["steps"].values())),
        row("seconds of training", lambda runs: across([sum(r["seconds"].values()) for r in runs], ".0f")),
        row("load of the machine", seeds("load", digits=".2g")),
        row("next frame, mm", error("model", False), next_frame(first, "constant velocity", False)),
        row("next frame in turns, mm", error("model", True), next_frame(first, "constant velocity", True)),
        row("autoencoder alone, mm", error("autoencoder", False)),
        *(row(f"next frame, {n} sampling steps, mm", seeds("sampling_steps", str(n))) for n in measures.SAMPLING_STEPS),
        row("heading error, degrees", seeds("rollout", "heading_error"), truth("heading_error")),
        row(obeyed, seeds("rollout", "obeyed", digits=".0%"), truth("obeyed", ".0%")),
        row("speed under a key, m/s", seeds("rollout", "speed"), truth("speed")),
        row("speed under idle, m/s", seeds("rollout", "idle_speed"), truth("idle_speed")),
        row("turns of 180 degrees completed", lambda runs: completed(runs, 180), truth("turn_frames_180") + " frames"),
        row("turns of 90 degrees completed", lambda runs: completed(runs, 90), truth("turn_frames_90") + " frames"),
        row(f"frames of {args.frames} before it is lost", seeds("rollout", "frames")),
        row("distance to the nearest training frame, mm", seeds("rollout", "distance_mm")),
        row("its drift, mm in 1,000 frames", seeds("rollout", "drift_mm_in_1000_frames")),
        row("diversity of the next frame, mm", seeds("diversity", "pose", "0")),
        row("diversity of the last frame, pose, mm", seeds("diversity", "pose", "-1"), truth("two_poses_mm")),
        row("diversity of the last frame, place, mm", seeds("diversity", "place", "-1")),
        row("ms a frame", seeds("ms_a_frame")),
    ]
    head = ["", *results, "constant velocity, or controller"]
    note = (
        f"{args.avatar}, {args.preset}, {args.scripts}, {args.seconds:g} s each; seeds: {args.seeds}. Means over "
        "seeds (their range); next frames: mean of the seeds with a 95 % interval from a bootstrap over the held-out "
        "sequences (range of the seeds). Diversity of the last frame, controller: the distance of two arbitrary "
        "held-out poses.\n\n"
    )
    return note + "".join(f"| {' | '.join(line)} |\n" for line in [head, ["---"] * len(head), *rows])


def next_frame(runs: Sequence[dict[str, typing.Any]], of: str, turning: bool) -> str:
    """Mean over seeds of one error of the next frame, its interval over sequences, and the range of the seeds."""
    part = runs[0]["next_frame"]
    keep = np.array(part["turning"], bool) | (not turning)
    if of not in part or not keep.any():
        return "none"
    each = np.array([r["next_frame"][of] for r in runs])[:, keep]
    estimate = bootstrap(each.mean(0), np.array(part["sequence"])[keep])
    spread = f" ({each.mean(1).min():.1f} to {each.mean(1).max():.1f})" if len(runs) > 1 and of == "model" else ""
    return f"{estimate:.1f}{spread}"


def completed(runs: Sequence[dict[str, typing.Any]], angle: int) -> str:
    """Turns completed of turns asked for, over all seeds, and their mean length."""
    asked, count, frames = 0, 0, 0.0
    for rolled in (r["rollout"] for r in runs):
        done = rolled.get(f"turns_{angle}_completed", 0)
        asked, count = asked + rolled.get(f"turns_{angle}", 0), count + done
        frames += done * (rolled.get(f"turn_frames_{angle}") or 0.0)
    return f"{count} of {asked}" + (f", {frames / count:.1f} frames" if count else "")


def pick(tree: typing.Any, keys: Sequence[str]) -> float | None:
    """A number in a tree of JSON, None where there is none; a list is indexed by the number in the key."""
    for key in keys:
        tree = tree[int(key)] if isinstance(tree, list) else tree.get(key)
        if tree is None:
            return None
    return float(tree)


def across(values: Sequence[float | None], digits: str) -> str:
    """The mean over seeds and, for several, their range."""
    known = [v for v in values if v is not None]
    if not known:
        return "none"
    if len(known) == 1:
        return f"{known[0]:{digits}}"
    return f"{np.mean(known):{digits}} ({min(known):{digits}} to {max(known):{digits}})"


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(run, Args, "experiments.unica_dynamics", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
