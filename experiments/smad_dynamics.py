"""Learn from true motion how clothes swing, and compare with yardsticks and ablations: SMAD's dynamics without cameras.

    python -m experiments.smad_dynamics --avatar cowgirl --preset ci             # every method, one seed
    python -m experiments.smad_dynamics --methods ours MLP --seeds 3             # some of them, with other seeds
    python -m experiments.smad_dynamics --methods ours --motions 18 6 36 72      # what more motions are worth
    python -m experiments.smad_dynamics --avatar ghostlady --methods ours        # cloth that nobody can predict

An avatar is simulated in motions to learn from and to measure on; nodes are points of its mesh, so that errors are in
millimetres and no camera's blind side counts. Every learned method takes the same number of steps. Twins are the same
motions again, the body trembling by half a millimetre: what they differ by cannot be predicted by anything, and even a
prediction that is right on average is off by about 0.7 of it. Results lie in OUT/smad_dynamics/AVATAR/PRESET/:
dynamics.md, dynamics.json and plots. A second run reuses what is finished, an interrupted one goes on.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np

from avatarjax import smad
from avatarjax.data import avatars
from avatarjax.io import atomic
from avatarjax.metrics import environment
from avatarjax.smad import dynamics, linear, train_dynamics
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.dynamics import System
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run, read_metrics
from experiments import command_line, smad_dynamics_tables
from experiments import smad_dynamics_measures as measures
from experiments.smad_dynamics_measures import Found, Method
from experiments.smad_dynamics_tables import (
    DAMPING,
    DRAPE,
    EQUILIBRIUM,
    ISOMETRY,
    KERNEL,
    LENGTH,
    MEAN,
    OURS,
    RIDGE,
    SKINNING,
    SPACE,
    TWINS,
    Results,
)
from experiments.smad_motions import Motions, Name, Stage, all_of, on_nodes

MOTIONS = Motions()
MEASURES = 4  # which version of the measures: kept ones of another are taken anew


def net(config: SmadConfig, **changes: typing.Any) -> SmadConfig:
    """The configuration with another deformer."""
    return dataclasses.replace(config, deformer=dataclasses.replace(config.deformer, **changes))


def _dynamics(config: SmadConfig, **changes: typing.Any) -> SmadConfig:
    return dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, **changes))


def _nodes(config: SmadConfig, times: float) -> SmadConfig:
    return dataclasses.replace(config, graph=dataclasses.replace(config.graph, nodes=round(times * config.graph.nodes)))


def _longer(config: SmadConfig, times: float) -> SmadConfig:
    stages = {name: getattr(config.dynamics, name) for name in ("target_stage", "stage")}
    counts = {name: max(1, round(times * stage.steps)) for name, stage in stages.items()}
    return _dynamics(config, **{name: dataclasses.replace(stages[name], steps=n) for name, n in counts.items()})


def _regular(config: SmadConfig) -> SmadConfig:
    """A1: the network says where nodes are, from the state and the poses; no edge features, no learned k_ij."""
    config = net(config, edge_features=False, strain=False, adaptive_stiffness=False)
    return dataclasses.replace(config, motion="deltas", equilibrium=False)


def _free(config: SmadConfig) -> SmadConfig:
    """Without the terms of Eq. 11."""
    pictures = dataclasses.replace(config.pictures, isometry=0.0)
    return dataclasses.replace(_dynamics(config, isometry=0.0, damping=0.0), pictures=pictures)


def _edges(config: SmadConfig) -> SmadConfig:
    return net(_regular(config), adaptive_stiffness=True, edge_features=True, strain=True)


# Each learned method by its name, as a change of the preset; the letters are those of SMAD Tables 2 and 4.
LEARNED: dict[str, Callable[[SmadConfig], SmadConfig]] = {
    OURS: lambda c: c,
    "MLP": lambda c: net(c, iterations=0),
    "vanilla GNN": lambda c: net(c, edge_features=False, strain=False, adaptive_stiffness=False),
    "A0 base": lambda c: _free(_regular(c)),
    "A1 + losses": _regular,
    "A2 + learned k_ij": lambda c: net(_regular(c), adaptive_stiffness=True),
    "A3 + edge features": _edges,
    "A5 + springs, Euler step": lambda c: dataclasses.replace(_edges(c), motion="springs"),
    "B0 no velocities": lambda c: net(c, velocities=0),
    "B1 tau_v = 1": lambda c: net(c, velocities=2),
    "B2 tau_v = 7": lambda c: net(c, velocities=8),
    "B3 tau_v = 15": lambda c: net(c, velocities=16),
    "C1 half the nodes": lambda c: _nodes(c, 0.5),
    "C3 twice the nodes": lambda c: _nodes(c, 2.0),
    "without memory": lambda c: _dynamics(c, memory=0),
    "equilibrium of the network alone": lambda c: _dynamics(c, components=0),
    **{f"{ISOMETRY}{w:g}": lambda c, w=w: _dynamics(c, isometry=w) for w in (0.0, 0.01, 0.1, 1.0)},
    **{f"{DAMPING}{w:g}": lambda c, w=w: _dynamics(c, damping=w) for w in (0.0, 0.01, 0.1, 1.0)},
    **{f"{times:g}{LENGTH}": lambda c, times=times: _longer(c, times) for times in (0.1, 0.3, 3.0)},
}


@dataclasses.dataclass
class Args:
    """Learn dynamics from true motion, and compare ways of doing so on motions that were not learned from."""

    avatar: str = "cowgirl"
    """Which avatar: monk, cowgirl, survival, berserker or ghostlady."""
    preset: str = "ci"
    """Sizes: ci, small, base or paper."""
    methods: tuple[str, ...] = ()
    """Learned methods; default: all. Yardsticks are always measured."""
    seeds: int = 1
    """How many seeds of training; the motions are the same for all."""
    motions: tuple[int, ...] = (18,)
    """How many motions to learn from: the comparison is made with the first number, and ours and the yardsticks are
    measured with the others as well."""
    out: Path = Path("runs")
    """Folder under which results go."""


def run(args: Args) -> Path:
    """Simulate, train and measure what is missing, then write the comparison; returns the folder of the results."""
    config, wanted = checked(args)
    home = args.out / "smad_dynamics" / args.avatar
    folder = home / args.preset
    folder.mkdir(parents=True, exist_ok=True)
    stage = Stage(home / f"motions-{config.film.substeps}", args.avatar, config.film.substeps)
    takes = {
        part: {name: stage.tracks(name) for name in names}
        for part, names in all_of(MOTIONS.learning(max(args.motions))).items()
    }
    results: dict[int, Results] = {}
    text = ""
    for count in args.motions:
        for name in wanted if count == args.motions[0] else (OURS,):
            for seed in range(args.seeds):
                place = folder / f"motions{count}" / name.replace(" ", "_") / f"seed{seed}"
                for method, found in one(LEARNED[name](config), stage, takes, count, place, name, seed).items():
                    results.setdefault(count, {}).setdefault(method, []).append(found)
                # A process may hold so many memory mappings, and each method compiles programs of its own.
                jax.clear_caches()
            text = report(args, config, results, folder)
    print(text, flush=True)
    return folder


def checked(args: Args) -> tuple[SmadConfig, tuple[str, ...]]:
    """The preset's configuration and the methods that are asked for; ValueError says what is wrong."""
    if args.avatar not in avatars.names():
        raise ValueError(f"unknown avatar {args.avatar!r}: choose one of {', '.join(avatars.names())}")
    if args.seeds < 1:
        raise ValueError("a comparison needs at least one seed")
    for name in args.methods:
        if name not in LEARNED:
            raise ValueError(f"unknown method {name!r}: choose of {', '.join(LEARNED)}")
    known = len(MOTIONS.train)
    if not args.motions or len(set(args.motions)) < len(args.motions) or not all(0 < n <= known for n in args.motions):
        raise ValueError(f"--motions {args.motions}: give different numbers from 1 to {known}")
    # Ours first: what others are compared with.
    return smad.preset(args.preset), (OURS, *(n for n in args.methods or LEARNED if n != OURS))


def one(
    config: SmadConfig,
    stage: Stage,
    takes: Mapping[str, Mapping[Name, Take]],
    count: int,
    place: Path,
    name: str,
    seed: int,
) -> dict[str, Found]:
    """Train a method on the first so many motions and measure it, and with ours all yardsticks; what was measured of
    the same is read back."""
    motions = MOTIONS.learning(count)
    path, mark = place / "measures.json", fingerprint(config, stage, motions, seed)
    if path.is_file() and (known := json.loads(path.read_text())).get("mark") == mark:
        return known["found"]
    print(f"{name}, {count} motions, seed {seed}", flush=True)
    graph, skin, chosen = stage.nodes(config.graph)
    parts = {part: {n: on_nodes(takes[part][n], chosen) for n in names} for part, names in all_of(motions).items()}
    learned = list(parts["train"].values())
    config = dynamics.sized(config, learned[0].poses.rotations.shape[1])
    system = train_dynamics.fit_system(config, graph, skin, learned)
    params = train_dynamics.train(config, system, learned, Run(place, seed, mark))
    recorded = train_dynamics.record(config, system, learned)
    system = train_dynamics.knowing(config, params, system, recorded)
    methods: dict[str, Method] = {name: measures.of_avatar(config, params, system)}
    if name == OURS:
        methods |= yardsticks(config, params, system, recorded)
        methods[TWINS] = twins(stage, chosen, motions)
    loose = measures.loose(np.asarray(recorded.offsets))
    skinned = measures.of_skinning(system)
    found = {label: measures.measure(method, parts, loose, skinned) for label, method in methods.items()}
    found[name]["seconds"] = sum(r[-1]["seconds"] for p in place.glob("*.jsonl") if (r := read_metrics(p)))
    if name == OURS:
        found[name]["similarity"] = measures.similarity(config, system, parts)
    atomic.write_text(path, json.dumps({"mark": mark, "found": found}))
    if name == OURS:
        show = next(iter(parts["test"]))
        measures.draw_nodes(place.parent.parent / "nodes.png", methods, parts["test"][show], show, (OURS, SKINNING))
    return found


def fingerprint(config: SmadConfig, stage: Stage, motions: Motions, seed: int) -> str:
    """What tells a measurement from others."""
    what = f"{MEASURES} {config} {stage.name} {stage.config} {motions} {seed}"
    return hashlib.sha256(what.encode()).hexdigest()[:12]


def yardsticks(config: SmadConfig, params: typing.Any, system: System, recorded: typing.Any) -> dict[str, Method]:
    """What needs no network, and what our network says of poses without dynamics."""
    known = recorded.offsets, recorded.features, recorded.first
    models = {
        MEAN: linear.fit(*known, components=0),
        RIDGE: linear.fit(*known),
        SPACE: linear.fit(*known, lags=2),
    }
    methods = {label: measures.of_linear(config, model, system) for label, model in models.items()}
    # The equilibrium from which the network has not departed is the drape.
    drape = params | {"target": 0 * params["target"]}
    windows = _dynamics(config, memory=0)
    forgetful = system.replace(drape=train_dynamics.fit_drape(windows, recorded))
    return methods | {
        KERNEL: measures.of_equilibrium(windows, drape, forgetful),
        DRAPE: measures.of_equilibrium(config, drape, system),
        SKINNING: measures.of_skinning(system),
        EQUILIBRIUM: measures.of_equilibrium(config, params, system),
    }


def twins(stage: Stage, chosen: np.ndarray, motions: Motions) -> Method:
    """The motions of the test simulated again with a trembling body; of others nothing is known."""

    def method(name: Name, take: Take) -> np.ndarray | None:
        if name not in motions.test:
            return None
        return np.asarray(on_nodes(stage.tracks(name, twin=True), chosen).positions)

    return method


def report(args: Args, config: SmadConfig, results: dict[int, Results], folder: Path) -> str:
    """Write dynamics.json, dynamics.md and plots; returns the tables. `results` by number of motions."""
    made_on = ", ".join(f"{key} {value}" for key, value in environment.describe().items())
    steps = config.dynamics.target_stage.steps, config.dynamics.stage.steps
    about = (
        f"{args.avatar}, {args.preset}, {config.graph.nodes} nodes; {args.motions[0]} motions to learn from; "
        f"learned methods: {steps[0]} steps of the equilibrium and {steps[1]} of rollouts, {args.seeds} seed(s). "
    )
    made = [table.markdown() for table in smad_dynamics_tables.tables(about, results, MOTIONS)]
    command = f"python -m experiments.smad_dynamics --avatar {args.avatar} --preset {args.preset}"
    command += f" --seeds {args.seeds} --motions {' '.join(map(str, args.motions))}"
    text = "\n".join([*made, f"`{command}` on {made_on}.", ""])
    smad_dynamics_tables.plots(folder, results[args.motions[0]], MOTIONS)
    atomic.write_text(folder / "dynamics.md", text)
    atomic.write_text(folder / "dynamics.json", json.dumps(results, indent=1))
    return text


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(run, Args, "experiments.smad_dynamics", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
