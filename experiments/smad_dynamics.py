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
import math
import typing
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np

from avatarjax import smad
from avatarjax.data import avatars
from avatarjax.io import atomic
from avatarjax.metrics import environment, published
from avatarjax.metrics.statistics import Estimate, bootstrap, paired_t_test
from avatarjax.smad import dynamics, linear, train_dynamics
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.dynamics import System
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run
from experiments import command_line, pictures
from experiments import smad_dynamics_measures as measures
from experiments.smad_dynamics_measures import Found, Method
from experiments.smad_motions import Motions, Name, Stage, all_of, on_nodes
from experiments.tables.table import Table

MOTIONS = Motions()
PARTS = ("train", "test", "unseen")
TWINS, SKINNING, MEAN, RIDGE, SPACE, POSES, OURS = (
    "twins",
    "skinning",
    "mean drape",
    "ridge regression",
    "linear state space",
    "pose window alone",
    "ours",
)
Results = dict[str, list[Found]]  # by method, of every seed
YARDSTICKS = (SKINNING, MEAN, RIDGE, SPACE, POSES)


def _net(config: SmadConfig, **changes: typing.Any) -> SmadConfig:
    return dataclasses.replace(config, deformer=dataclasses.replace(config.deformer, **changes))


def _losses(config: SmadConfig, **changes: typing.Any) -> SmadConfig:
    return dataclasses.replace(config, dynamics=dataclasses.replace(config.dynamics, **changes))


def _nodes(config: SmadConfig, times: float) -> SmadConfig:
    return dataclasses.replace(config, graph=dataclasses.replace(config.graph, nodes=round(times * config.graph.nodes)))


def _longer(config: SmadConfig, times: int) -> SmadConfig:
    stage = config.dynamics.target_stage
    return _losses(config, target_stage=dataclasses.replace(stage, steps=times * stage.steps))


def _regular(config: SmadConfig) -> SmadConfig:
    """A1: the network says where nodes are, from the state and the poses; no edge features, no learned k_ij."""
    config = _net(config, edge_features=False, strain=False, adaptive_stiffness=False)
    return dataclasses.replace(config, motion="deltas", equilibrium=False)


def _edges(config: SmadConfig) -> SmadConfig:
    return _net(_regular(config), adaptive_stiffness=True, edge_features=True, strain=True)


# Each learned method by its name, as a change of the preset; the letters are those of SMAD Tables 2 and 4.
LEARNED: dict[str, Callable[[SmadConfig], SmadConfig]] = {
    OURS: lambda c: c,
    "MLP": lambda c: _net(c, iterations=0),
    "vanilla GNN": lambda c: _net(c, edge_features=False, strain=False, adaptive_stiffness=False),
    "A0 base": lambda c: _losses(_regular(c), isometry=0.0, damping=0.0),
    "A1 + losses": _regular,
    "A2 + learned k_ij": lambda c: _net(_regular(c), adaptive_stiffness=True),
    "A3 + edge features": _edges,
    "A5 + springs, Euler step": lambda c: dataclasses.replace(_edges(c), motion="springs"),
    "B0 no velocities": lambda c: _net(c, velocities=0),
    "B1 tau_v = 1": lambda c: _net(c, velocities=2),
    "B2 tau_v = 7": lambda c: _net(c, velocities=8),
    "B3 tau_v = 15": lambda c: _net(c, velocities=16),
    "C1 half the nodes": lambda c: _nodes(c, 0.5),
    "C3 twice the nodes": lambda c: _nodes(c, 2.0),
    "equilibrium of the network alone": lambda c: _losses(c, components=0),
    "equilibrium 4 times as long": lambda c: _longer(c, 4),
    "isometry 0": lambda c: _losses(c, isometry=0.0),
    "isometry 0.1": lambda c: _losses(c, isometry=0.1),
    "damping 0": lambda c: _losses(c, damping=0.0),
    "damping 0.1": lambda c: _losses(c, damping=0.1),
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
    for count in args.motions:
        for name in wanted if count == args.motions[0] else (OURS,):
            for seed in range(args.seeds):
                place = folder / f"motions{count}" / name.replace(" ", "_") / f"seed{seed}"
                for method, found in one(LEARNED[name](config), stage, takes, count, place, name, seed).items():
                    results.setdefault(count, {}).setdefault(method, []).append(found)
                # A process may hold so many memory mappings, and each method compiles programs of its own.
                jax.clear_caches()
            report(args, config, results, folder)
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
    methods: dict[str, Method] = {name: measures.of_avatar(config, params, system)}
    if name == OURS:
        methods |= yardsticks(config, params, system, recorded)
        methods[TWINS] = twins(stage, chosen, motions)
    loose = measures.loose(np.asarray(recorded.offsets))
    skinned = measures.of_skinning(system)
    found = {label: measures.measure(method, parts, loose, skinned) for label, method in methods.items()}
    atomic.write_text(path, json.dumps({"mark": mark, "found": found}))
    if name == OURS:
        show = next(iter(parts["test"]))
        measures.draw_nodes(place.parent.parent / "nodes.png", methods, parts["test"][show], show, (OURS, SKINNING))
    return found


def fingerprint(config: SmadConfig, stage: Stage, motions: Motions, seed: int) -> str:
    """What tells a measurement from others."""
    return hashlib.sha256(f"{config} {stage.name} {stage.config} {motions} {seed}".encode()).hexdigest()[:12]


def yardsticks(config: SmadConfig, params: typing.Any, system: System, recorded: typing.Any) -> dict[str, Method]:
    """What needs no network, and what our network says of poses without dynamics."""
    known = recorded.offsets, recorded.features, recorded.first
    models = {
        MEAN: linear.fit(*known, components=0),
        RIDGE: linear.fit(*known),
        SPACE: linear.fit(*known, lags=2),
    }
    methods = {label: measures.of_linear(config, model, system) for label, model in models.items()}
    return methods | {
        SKINNING: measures.of_skinning(system),
        POSES: measures.of_equilibrium(config, params, system),
    }


def twins(stage: Stage, chosen: np.ndarray, motions: Motions) -> Method:
    """The motions of the test simulated again with a trembling body; of others nothing is known."""

    def method(name: Name, take: Take) -> np.ndarray | None:
        if name not in motions.test:
            return None
        return np.asarray(on_nodes(stage.tracks(name, twin=True), chosen).positions)

    return method


def report(args: Args, config: SmadConfig, results: dict[int, Results], folder: Path) -> None:
    """Write dynamics.json, dynamics.md and plots, and print the tables; `results` by number of motions."""
    made_on = ", ".join(f"{key} {value}" for key, value in environment.describe().items())
    made = [table.markdown() for table in tables(args, config, results)]
    command = f"python -m experiments.smad_dynamics --avatar {args.avatar} --preset {args.preset}"
    command += f" --seeds {args.seeds} --motions {' '.join(map(str, args.motions))}"
    text = "\n".join([*made, f"`{command}` on {made_on}.", ""])
    atomic.write_text(folder / "dynamics.md", text)
    atomic.write_text(folder / "dynamics.json", json.dumps(results, indent=1))
    print(text, flush=True)
    first = results[args.motions[0]]
    shown = [name for name in (SKINNING, RIDGE, OURS, "B0 no velocities") if name in first]
    for kind in MOTIONS.long:
        label = measures.label(kind)
        lines = {n: np.array(first[n][0]["long"][label]["curve"]) for n in shown if label in first[n][0]["long"]}
        x = {n: np.stack([np.arange(len(y)) * measures.BLOCK / 30, y], axis=1) for n, y in lines.items()}
        pictures.plot_lines(folder / f"long-{label}.png", x, "seconds", "error of loose nodes, mm")


def tables(args: Args, config: SmadConfig, results: dict[int, Results]) -> list[Table]:
    """All tables of the results that there are."""
    steps = config.dynamics.target_stage.steps, config.dynamics.stage.steps
    about = (
        f"{args.avatar}, {args.preset}, {config.graph.nodes} nodes; {args.motions[0]} motions to learn from; "
        f"learned methods: {steps[0]} steps of the equilibrium and {steps[1]} of rollouts, {args.seeds} seed(s). "
    )
    first = results[args.motions[0]]
    made = [main_table(about, first), swing_table(first)]
    if any(name in first for name in LEARNED if name != OURS):
        made.append(paper_table(first))
    if len(results) > 1:
        made.append(data_table(results))
    return [*made, long_table(first)]


def data_table(results: dict[int, Results]) -> Table:
    """What more motions to learn from are worth."""
    rows = []
    for count in sorted(results):
        found = results[count]
        cells = [across(found[name], "test", "loose") for name in (MEAN, RIDGE, SPACE, POSES, OURS)]
        unseen = [across(found[name], "unseen", "loose") for name in (RIDGE, OURS)]
        rows.append([count, *cells, compared(found[OURS], found[RIDGE], "test"), *unseen])
    return Table(
        "How much motion it is learned from",
        "Loose nodes, mm; the same motions of the test throughout, the learned methods trained for the same steps. p: "
        "ours against ridge regression.",
        ["motions", MEAN, RIDGE, SPACE, POSES, OURS, "p", f"unseen, {RIDGE}", f"unseen, {OURS}"],
        rows,
    )


def main_table(about: str, results: Results) -> Table:
    """Errors on all parts, and whether a method differs from ours."""
    rows = []
    for name in ordered(results):
        cells = [across(results[name], part, "loose") for part in PARTS]
        p = None if name in (OURS, TWINS) else compared(results[OURS], results[name], "test")
        rows.append([name, across(results[name], "test", "all"), *cells, p])
    return Table(
        "Where the cloth is (SMAD Tables 2, 3, J and K, in millimetres)",
        about + "Mean distance of nodes to their true places; loose are the "
        f"{measures.LOOSE:.0%} of the nodes that are furthest from their mean offset in training. Rollouts from rest; "
        "intervals are a bootstrap over motions; p: two-sided paired t-test against ours over the motions of the test. "
        f"Nodes that are lost count as {measures.LOST:g} m away.",
        ["method", "test, all nodes", *(f"{part}, loose" for part in PARTS), "p"],
        rows,
    )


def swing_table(results: Results) -> Table:
    """Does it swing as much as it should, and in time?"""
    rows = [
        [n, *(across(results[n], "test", what) for what in ("swing", "lag", "acceleration", "spikes"))]
        for n in ordered(results)
    ]
    return Table(
        "How it swings (SMAD Fig. 6 left)",
        "Loose nodes on the motions of the test. Swing: speed in the body frame, root mean square, as a share of the "
        "true one. Lag: milliseconds by which the true motion comes after the method's (skinning's: how late cloth "
        "follows the body). Acceleration error, mm a frame squared; spikes: share of frames with more of it than three "
        "deviations above the median of skinning's.",
        ["method", "swing", "lag, ms", "acceleration error", "spikes"],
        rows,
    )


def paper_table(results: Results) -> Table:
    """SMAD Tables 2 and 4: order of the paper's PSNR, and ours of errors."""
    letters = ("A0", "A1", "A2", "A3", "B0", "B1", "B2", "B3")
    printed = {f"{key} ": published.SMAD_2.at(key, "PSNR").value for key in letters}
    rows, known = [], []
    for name in ordered(results):
        paper = next((value for key, value in printed.items() if name.startswith(key)), None)
        if name in ("MLP", "vanilla GNN", OURS):
            row = published.SMAD if name == OURS else name
            paper = published.SMAD_4.at((row, "test"), "PSNR").value
        if paper is None:
            continue
        here = mean(results[name], "test", "loose")
        known.append((paper, -here))
        rows.append([name, paper, here])
    pairs = [(a, b) for k, a in enumerate(known) for b in known[:k] if a[0] != b[0]]
    same = sum((a[0] > b[0]) == (a[1] > b[1]) for a, b in pairs)
    return Table(
        "The paper's order",
        "The paper's PSNR (higher is better) beside our error of loose nodes on the test, mm (lower is better). A4's "
        "latent codes change the look alone and are not in this comparison.",
        ["method", "paper, dB", "here, mm"],
        rows,
        [f"Of {len(pairs)} pairs, {same} are in the paper's order."],
    )


def long_table(results: Results) -> Table:
    """SMAD Table 5: errors on long sequences, and whether they grow."""
    rows = []
    for name in ordered(results):
        found = results[name][0]["long"]
        if found:
            cells = [x for label in found for x in (found[label]["loose"], estimate(found[label]["growth"]))]
            rows.append([name, *cells])
    columns = [x for kind in MOTIONS.long for x in (measures.label(kind), "growth, mm in 1,000 frames")]
    return Table(
        "Long sequences (SMAD Table 5)",
        "960 frames under the keyboard: keys that change (dynamic), one key held (repetitive). Loose nodes, mm; growth "
        "with its interval over blocks of frames. First seed.",
        ["method", *columns],
        rows,
    )


def ordered(results: Results) -> list[str]:
    """Twins, yardsticks, then what is learned."""
    first = [name for name in (TWINS, *YARDSTICKS) if name in results]
    return first + [name for name in results if name not in first]


def mean(seeds: list[Found], part: str, what: str) -> float:
    """The mean over motions and seeds."""
    return float(np.mean([value for found in seeds for value in found[part][what]]))


def across(seeds: list[Found], part: str, what: str) -> Estimate | None:
    """The mean over seeds of each motion, and its interval over motions."""
    if not seeds[0].get(part):
        return None
    return bootstrap(np.mean([found[part][what] for found in seeds], axis=0))


def compared(ours: list[Found], other: list[Found], part: str) -> float:
    """The p-value of the difference in the errors of loose nodes, motion by motion."""
    a, b = (np.mean([found[part]["loose"] for found in seeds], axis=0) for seeds in (ours, other))
    return paired_t_test(a, b).p


def estimate(cells: list[float]) -> Estimate:
    """A mean with its bounds as JSON had it."""
    value, low, high = cells
    return Estimate(value, low, high, 1) if math.isfinite(low) else Estimate(value, math.nan, math.nan, 1)


def main(argv: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    return command_line.run(run, Args, "experiments.smad_dynamics", __doc__, argv)


if __name__ == "__main__":
    raise SystemExit(main())
