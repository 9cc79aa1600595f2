"""Train an avatar that answers W/A/S/D, roll it out, and report: UNICA from simulated data to video.

    python -m experiments.unica --avatar cowgirl               # shows the shipped avatar, where there is one
    python -m experiments.unica --avatar cowgirl --train       # trains it: preset small, the default on a CPU
    python -m experiments.unica --avatar cowgirl --preset ci   # everything, both dynamics models, in minutes
    python -m experiments.unica --avatar cowgirl --dynamics unet --appearance point_transformer   # the paper's parts
    python -m experiments.unica --avatar cowgirl --stage report

Stages in order: data, vae, unet, coefficients, pca, base, appearance, texels, rollout, report. Results lie in
OUT/unica/AVATAR/PRESET/; open report.html there. A second run reuses what is finished, an interrupted one goes on.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shutil
import time
import typing
from collections.abc import Callable
from pathlib import Path

import jax

from avatarjax import posmap, unica
from avatarjax.data import MeshSequence, avatars, building, dataset, load_mesh_sequence
from avatarjax.io import atomic
from avatarjax.metrics import lpips, pretrained
from avatarjax.train import read_metrics
from avatarjax.unica import files, train, train_appearance
from avatarjax.unica.config import AppearanceName, DynamicsName, UnicaConfig
from experiments import command_line, pictures, unica_report, unica_shipped
from experiments.clock import Clock
from experiments.unica_rollout import SCRIPT, roll_and_draw

STAGES = ("data", "vae", "unet", "coefficients", "pca", "base", "appearance", "texels", "rollout", "report")


@dataclasses.dataclass
class Args:
    """Train a keyboard-controlled avatar and report how well it obeys."""

    avatar: str = "cowgirl"
    """Which avatar to build and train: monk, cowgirl, survival, berserker or ghostlady."""
    meshes: Path | None = None
    """Train on your own mesh sequence instead: what avatarjax.data.load_mesh_sequence reads (docs/data_import.md)."""
    axes: str | None = None
    """Axes of --meshes: gltf, blender, unreal or unreal-mesh. Default: told from the first frame."""
    train: bool = False
    """Train from scratch, also an avatar whose weights are shipped; any option but --avatar and --out means it too."""
    preset: str = ""
    """Sizes: ci, small, base or paper. Without it, small on a CPU and base on an accelerator."""
    dynamics: DynamicsName | None = None
    """The model that drives the rollout: coefficients (fast) or unet (the paper's). Default: the preset's."""
    appearance: AppearanceName | None = None
    """What dresses it: texels (fast) or point_transformer (the paper's). Default: the preset's."""
    stage: str = "all"
    """Run only this stage, anew; stages before it are reused, or run where they are missing."""
    resume: bool = True
    """Go on from checkpoints. --no-resume deletes this run's results first."""
    seed: int = 0
    """Seed of data, training and rollout; results of seeds other than 0 go to a folder PRESET-seedN."""
    out: Path = Path("runs")
    """Folder under which results go, as OUT/unica/AVATAR/PRESET/."""


@dataclasses.dataclass
class Experiment:
    """One run: its arguments, configuration, folder, and what its stages have produced so far."""

    args: Args
    config: UnicaConfig
    folder: Path
    meshes: MeshSequence | None = None

    @functools.cached_property
    def clock(self) -> Clock:
        """How long its stages took."""
        return Clock(self.folder / "seconds.json")

    @property
    def models(self) -> tuple[DynamicsName, ...]:
        """The dynamics models that this run trains, the one that drives its rollout first."""
        names = typing.get_args(DynamicsName)
        others = tuple(n for n in names if n != self.config.dynamics)
        return (self.config.dynamics, *(others if self.config.train_both else ()))

    @property
    def appearances(self) -> tuple[AppearanceName, ...]:
        """The appearance models that this run trains, the one that dresses its rollout first."""
        names = typing.get_args(AppearanceName)
        others = tuple(n for n in names if n != self.config.appearance_model)
        return (self.config.appearance_model, *(others if self.config.train_both else ()))

    def stages(self) -> list[str]:
        """The stages of this run in order."""
        skipped = set()
        if "unet" not in self.models:
            # The coefficient model's maps need no alignment.
            skipped |= {"vae", "unet", "pca"}
        if "coefficients" not in self.models:
            skipped.add("coefficients")
        if "point_transformer" not in self.appearances:
            skipped.add("appearance")
        if "texels" not in self.appearances:
            skipped.add("texels")
        return [s for s in STAGES if s not in skipped]

    def spec(self) -> dataset.DatasetSpec:
        """What this run's dataset is made of."""
        data = dataclasses.asdict(self.config.data)
        return dataset.DatasetSpec(
            avatar=self.args.avatar,
            source="" if self.meshes is None else building.describe(self.meshes),
            size=self.config.size,
            upscaled=self.config.upscaled,
            script=SCRIPT,
            seed=self.args.seed,
            **data,
        )


def run_experiment(args: Args) -> Path:
    """Run the stages that `args` ask for, or show a shipped avatar; returns the folder of the results."""
    shipped = files.shipped().get(args.avatar)
    if shipped is not None and args == Args(avatar=args.avatar, out=args.out):
        return unica_shipped.show(args.avatar, shipped, args.out / "unica" / args.avatar / "shipped")
    experiment = prepare(args)
    folder, config = experiment.folder, experiment.config
    wanted = experiment.stages() if args.stage == "all" else [args.stage]
    last = experiment.stages().index(wanted[-1])
    redo = set() if args.stage == "all" else set(wanted)
    if redo:
        forget(experiment, args.stage)
    began = time.monotonic()

    def announce(stage: str, text: str) -> None:
        print(f"[{time.monotonic() - began:6.1f} s] {stage}: {text}", flush=True)

    print(f"avatar {args.avatar}, preset {args.preset}, dynamics {' and '.join(experiment.models)}, into {folder}")
    if dataset.matches(folder / "data", experiment.spec()):
        announce("data", "finished before, reused")
    else:
        announce("data", "simulating and rendering")
        experiment.clock.run("data", lambda: building.build(folder / "data", experiment.spec(), experiment.meshes))
    data = dataset.load(folder / "data")
    if last == 0:
        return folder
    run = train.Run(folder / "checkpoints", args.seed, dataset.fingerprint(folder / "data"))

    trained: dict[str, typing.Any] = {}
    upscaler = posmap.build_upscaler(data.atlas, config.upscaled)
    seen = perceptual_network(config) if config.loss_lpips else None
    steps: dict[str, Callable[[], typing.Any]] = {
        "vae": lambda: train.train_vae(config, data, run, train.new_latent_dynamics(config, data, run)),
        "unet": lambda: train.train_unet(config, data, run, trained["vae"]),
        "coefficients": lambda: train.train_coefficients(config, data, run),
        "pca": lambda: train.fit_alignment(config, data, run),
        "base": lambda: train_appearance.train_base(config, data, run, upscaler, seen),
        "appearance": lambda: train_appearance.train_appearance(config, data, run, upscaler, trained["base"], seen),
        "texels": lambda: train_appearance.train_texels(config, data, run, upscaler, trained["base"], seen),
    }
    for stage in experiment.stages()[1 : last + 1]:
        if stage in steps:
            announce(stage, "fitting" if stage == "pca" else "training")
            trained[stage] = experiment.clock.run(stage, steps[stage])
            plot_stage(experiment, stage)
    if last < experiment.stages().index("rollout"):
        return folder

    built = {
        name: assemble(config, data, upscaler, trained, name, config.appearance_model) for name in experiment.models
    }
    for name, avatar in built.items():
        files.save(folder / files.file_name(name), avatar)
    avatar = built[config.dynamics]
    dressed = {
        name: assemble(config, data, upscaler, trained, config.dynamics, name) for name in experiment.appearances
    }
    announce("rollout", f"{len(SCRIPT)} frames, four views each")
    frames = experiment.clock.run("rollout", lambda: roll_and_draw(avatar, SCRIPT, folder, args.seed))
    if last == experiment.stages().index("report"):
        announce("report", "measuring against held-out data")
        experiment.clock.run(
            "report",
            lambda: unica_report.write(experiment, data, built, dressed, trained["base"], frames, SCRIPT),
        )
        announce("report", f"open {folder / 'report.html'}")
    return folder


def prepare(args: Args) -> Experiment:
    """Check the arguments and make the run's folder; ValueError says what is wrong and what there is."""
    meshes = None
    if args.meshes is not None:
        meshes = load_mesh_sequence(args.meshes, axes=args.axes)
        args.avatar = args.meshes.stem
    elif args.avatar not in avatars.names():
        raise ValueError(f"unknown avatar {args.avatar!r}: choose one of {', '.join(avatars.names())}")
    args.preset = args.preset or ("small" if jax.default_backend() == "cpu" else "base")
    config = unica.preset(args.preset)
    if args.dynamics:
        config = dataclasses.replace(config, dynamics=args.dynamics)
    if args.appearance:
        config = dataclasses.replace(config, appearance_model=args.appearance)
    if meshes is not None:
        config = dataclasses.replace(config, actions=len(meshes.action_names))
    # Another seed is another run: it must not replace the results of the first.
    name = args.preset if args.seed == 0 else f"{args.preset}-seed{args.seed}"
    experiment = Experiment(args, config, args.out / "unica" / args.avatar / name, meshes)
    if args.stage not in ("all", *experiment.stages()):
        raise ValueError(f"unknown stage {args.stage!r} here: choose one of all, {', '.join(experiment.stages())}")
    if not args.resume and experiment.folder.exists():
        print(f"deleting the earlier results in {experiment.folder}")
        shutil.rmtree(experiment.folder)
    (experiment.folder / "checkpoints").mkdir(parents=True, exist_ok=True)
    atomic.write_text(experiment.folder / "config.json", json.dumps(dataclasses.asdict(config), indent=2))
    return experiment


def perceptual_network(config: UnicaConfig) -> lpips.Network | None:
    """The network of the LPIPS loss; None, and a message, where its weights have not been fetched."""
    if pretrained.available(config.lpips_network):
        return lpips.load(config.lpips_network)
    print(
        f"note: training without the LPIPS term, because the weights of {config.lpips_network} have not been fetched "
        f"({pretrained.COMMAND})"
    )
    return None


def forget(experiment: Experiment, stage: str) -> None:
    """Delete what a stage has made, so that it starts anew."""
    if stage == "data":
        shutil.rmtree(experiment.folder / "data", ignore_errors=True)
    for path in (experiment.folder / "checkpoints").glob(f"{stage}.*"):
        path.unlink()


def plot_stage(experiment: Experiment, stage: str) -> None:
    """Plot a stage's loss beside its checkpoint; a stage in closed form has none."""
    path = experiment.folder / "checkpoints" / f"{stage}.jsonl"
    if path.is_file():
        pictures.plot_losses(path.with_suffix(".png"), read_metrics(path), stage)


def assemble(
    config: UnicaConfig,
    data: dataset.Dataset,
    upscaler: posmap.Upscaler,
    trained: dict[str, typing.Any],
    dynamics: DynamicsName,
    appearance: AppearanceName,
) -> unica.Avatar:
    """A finished avatar from the results of the stages."""
    # The texel head has base attributes of its own.
    params, base = trained["texels"] if appearance == "texels" else (trained["appearance"], trained["base"])
    return unica.Avatar(
        atlas=data.atlas,
        upscaler=upscaler,
        tangents=posmap.tangents(data.atlas),
        pca=trained["pca"] if dynamics == "unet" else None,
        base=base,
        appearance=params,
        dynamics=trained[dynamics],
        standing=data.standing,
        config=dataclasses.replace(config, dynamics=dynamics, appearance_model=appearance),
    )


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(run_experiment, Args, "experiments.unica", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
