"""How a deformer is built, in pictures (SMAD Tables 2, 4 and 5): networks that differ in one thing, from one video."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax import smad
from avatarjax.data import MonocularVideo
from avatarjax.gaussians import Gaussians
from avatarjax.metrics import drift, lpips, pretrained
from avatarjax.metrics.published import SMAD, SMAD_2, SMAD_4, SMAD_5
from avatarjax.metrics.statistics import Estimate, bootstrap
from avatarjax.smad import driving, dynamics, files, hull, train_dynamics, train_pictures
from avatarjax.smad.config import SmadConfig
from avatarjax.smad.footage import Footage
from avatarjax.smad.graph import GraphConfig
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import Run
from experiments import smad as experiment
from experiments import smad_measures as measures
from experiments import smad_motions
from experiments.smad_dynamics import LEARNED, net
from experiments.smad_dynamics_tables import EQUILIBRIUM, OURS, SKINNING
from experiments.tables.table import Notebook, Table, mark

PARTS = ("train", "test", "unseen")
CODES, STILL = "without latent codes", "B0 no velocities"
# By name how a method differs from ours, and the paper's row with its printed PSNR; without a change it needs no
# training of its own.
METHODS: dict[str, tuple[Callable[[SmadConfig], SmadConfig] | None, float | None]] = {
    OURS: (LEARNED[OURS], SMAD_2.at("A4", "PSNR").value),
    "MLP": (LEARNED["MLP"], SMAD_4.at(("MLP", "test"), "PSNR").value),
    "vanilla GNN": (LEARNED["vanilla GNN"], SMAD_4.at(("vanilla GNN", "test"), "PSNR").value),
    CODES: (lambda c: net(c, codes=0), None),
    **{n: (LEARNED[n], SMAD_2.at(n[:2], "PSNR").value) for n in LEARNED if n[:2] in ("A0", "A1", "A2", "A3")},
    "A5 + springs, Euler step": (LEARNED["A5 + springs, Euler step"], None),
    **{n: (LEARNED[n], SMAD_2.at(n[:2], "PSNR").value) for n in LEARNED if n[:2] in ("B0", "B1", "B2", "B3", "C1")},
    # The paper's C3 has two and a half times its nodes.
    "C3 twice the nodes": (LEARNED["C3 twice the nodes"], SMAD_2.at("C3", "PSNR").value),
    SKINNING: (None, SMAD_2.at("C0", "PSNR").value),
    EQUILIBRIUM: (None, None),
}
# The long sequences of Table 5, and what the paper calls them.
LONG = {("keys", 0): "dynamic pose", ("run", 0): "repetitive pose"}
# Rollouts are learned from for so many times the steps of the preset, which has few.
LONGER = 10
# Frames of one second are alike: intervals are over pieces of a take of so many frames.
PIECE = 30

# Of every measured frame by metric; and mean errors of loose nodes, mm.
Values = dict[str, list[float]]


@dataclasses.dataclass
class Workshop:
    """A finished run of experiments.smad, whose deformer is learned anew in other ways below `place`."""

    folder: Path
    place: Path

    @property
    def name(self) -> str:
        """Of the run and of what it has learned."""
        return f"{self.folder.parent.name}-{self.folder.name}-{mark(self.folder / files.FILE)}"

    @functools.cached_property
    def config(self) -> SmadConfig:
        """Of the run, with more steps of rollouts."""
        config = smad.preset(self.folder.name)
        stage = config.pictures.swing_stage
        longer = dataclasses.replace(stage, steps=LONGER * stage.steps)
        return dataclasses.replace(config, pictures=dataclasses.replace(config.pictures, swing_stage=longer))

    @functools.cached_property
    def takes(self) -> dict[str, list[MonocularVideo]]:
        """Of the run, part by part, the slow turn first."""
        arguments = experiment.Args(avatar=self.folder.parent.name, preset=self.folder.name)
        return experiment.film(experiment.Experiment(arguments, smad.preset(self.folder.name), self.folder))

    def shown(self, part: str) -> list[MonocularVideo]:
        """The takes that are measured: the turn is not, in which nothing swings."""
        return self.takes[part][1:] if part == "train" else self.takes[part]

    def long(self, name: smad_motions.Name) -> MonocularVideo:
        """A long take, filmed as the others were."""
        film = experiment.filmed(self.place / "film", self.folder.parent.name, [name], self.config.film)
        return film[name]

    def settled(self, graph: GraphConfig) -> tuple[smad.Avatar, list[Take], Footage]:
        """What all methods on so many nodes depart from: the avatar of the run before it has learned to swing, the
        tracks of its nodes and the takes. On the run's own graph nothing is learned anew."""
        config = smad.preset(self.folder.name)
        own = graph == config.graph
        folder = self.folder / "checkpoints" if own else self.place / f"{graph.nodes}-nodes"
        config, run = dataclasses.replace(config, graph=graph), self.run(folder)
        start = hull.initialise(self.takes["train"][0], config.hull)
        refined = experiment.refined_gaussians(config, self.takes["train"], start, run)
        return *experiment.settle(config, self.takes["train"], refined, run), refined[1]

    def run(self, folder: Path) -> Run:
        """A training on the run's takes."""
        folder.mkdir(parents=True, exist_ok=True)
        return Run(folder, 0, experiment.fingerprint(self.takes["train"]))

    def learned(self, method: str) -> smad.Avatar:
        """The avatar with the deformer of a method. It is learned from rollouts that are drawn; without an equilibrium
        from those of tracks before, as there is nothing else that it could begin with."""
        change, _ = METHODS[method]
        assert change is not None
        config = dynamics.sized(change(self.config), self.takes["train"][0].poses.rotations.shape[1])
        avatar, tracks, takes = self.settled(config.graph)
        run = self.run(self.place / method.replace(" ", "-"))
        if config.equilibrium:
            fresh = dynamics.init(config, avatar.system, run.key("dynamics"))
            keep = train_dynamics.hold_equilibrium(config)
            assert keep is not None
            params = keep(fresh, avatar.params, None)
        else:
            params = train_dynamics.train(config, avatar.system, tracks, run)
        return train_pictures.train_swing(avatar.replace(config=config, params=params), takes, run)

    def measured(self, method: str, takes: Mapping[str, Sequence[MonocularVideo]]) -> dict[str, list[Values]]:
        """Of each measured frame of some takes what a method's pictures are like, and how far its loose nodes are off.

        Nodes that are lost count as a metre away.
        """
        change, _ = METHODS[method]
        avatar, name = (self.learned(OURS), method) if change is None else (self.learned(method), OURS)
        canonical, known = self.takes["train"][0], self.shown("train")
        truths = [_known(measures.true_nodes(avatar, canonical, take)) for take in known]
        loose = measures.loose_nodes(avatar, truths, [driving.recorded(take.poses) for take in known])

        def one(take: MonocularVideo) -> Values:
            moved = measures.move(avatar, driving.recorded(take.poses))[name]
            drawn = measures.Moved(lambda frame: visible(moved.gaussians(frame)), moved.nodes)
            values = measures.picture_values([measures.recorded_view(take)], {name: drawn}, perceptual())[name]
            truth = _known(measures.true_nodes(avatar, canonical, take))
            errors = np.linalg.norm(moved.nodes[:, loose] - truth[1:, loose], axis=-1).mean(axis=1)
            errors = 1000 * np.minimum(np.nan_to_num(errors, nan=1.0, posinf=1.0), 1.0)
            return values | {"loose": [float(errors[k - 1]) for k in measures.measured_frames(len(take))]}

        found = {part: [one(take) for take in some] for part, some in takes.items()}
        # A process may hold so many memory mappings, and each method compiles programs of its own.
        jax.clear_caches()
        return found


def visible(gaussians: Gaussians) -> Gaussians:
    """Gaussians of which those that are nowhere, after a rollout that diverged, are not drawn."""
    numbers = [jnp.reshape(x, (len(gaussians), -1)) for x in jax.tree.leaves(gaussians)]
    there = jnp.all(jnp.isfinite(jnp.concatenate(numbers, axis=1)), axis=1)
    known = jax.tree.map(lambda x: jnp.nan_to_num(x, posinf=0.0, neginf=0.0), gaussians)
    return known.replace(logit_opacities=jnp.where(there, known.logit_opacities, -20.0))


def deformers(folders: list[Path], notebook: Notebook, folder: Path, methods: Sequence[str] = ()) -> Table:
    """SMAD Tables 2 and 4: ours and these methods, by default all, on the run's other takes; checkpoints go below
    `folder`. Raises ValueError for an unknown method."""
    unknown = [method for method in methods if method not in METHODS]
    if unknown:
        raise ValueError(f"unknown method {unknown[0]!r}: choose of {', '.join(METHODS)}")
    chosen = [method for method in METHODS if not methods or method in {OURS, *methods}]
    rows: list[list[typing.Any]] = []
    remarks = []
    for run in folders:
        shop = Workshop(run, folder / "deformers" / run.parent.name)
        takes = {part: shop.shown(part) for part in PARTS}
        works = {method: functools.partial(shop.measured, method, takes) for method in chosen}
        found = {method: notebook.measured(f"{shop.name}, {method}", work) for method, work in works.items()}
        for method in chosen:
            cells = [pooled(found[method][part], "PSNR") for part in PARTS]
            test = found[method]["test"]
            cells += [pooled(test, "LPIPS"), pooled(test, "loose"), less(found[OURS]["test"], test, "PSNR")]
            rows.append([run.parent.name, method, METHODS[method][1], *cells])
        remarks.append(f"{run.parent.name}: {order({m: f['test'] for m, f in found.items()})}")
    return Table(
        "How the deformer is built (SMAD Tables 2 and 4)",
        f"Learned from one video, drawn through rollouts for {LONGER} times the steps of the preset, all from the same "
        "Gaussians and the same equilibrium, but that C1 and C3 learn both anew on other nodes, and A0 to A5 have no "
        "equilibrium, as in the paper, and learn from the tracks before. Rollouts from rest, one frame of five over "
        "black; intervals are over pieces of a second. Loose nodes: mean distance in mm to where they truly are. The "
        "last column is ours less the method, frame by frame. The paper's PSNR is of other subjects.",
        [
            "avatar",
            "method",
            "paper's PSNR",
            *(f"PSNR, {p}" for p in PARTS),
            "LPIPS",
            "loose nodes, mm",
            "ours less it",
        ],
        rows,
        remarks,
    )


def long_takes(folders: list[Path], notebook: Notebook, folder: Path) -> Table:
    """SMAD Table 5: pictures of long takes, and whether they become worse."""
    rows: list[list[typing.Any]] = []
    for run in folders:
        shop = Workshop(run, folder / "deformers" / run.parent.name)
        takes = {kind: (shop.long(name),) for name, kind in LONG.items()}
        works = {m: functools.partial(shop.measured, m, takes) for m in (OURS, STILL, EQUILIBRIUM, SKINNING)}
        found = {m: notebook.measured(f"{shop.name}, {m}, long", work) for m, work in works.items()}
        for kind, method in itertools.product(takes, works):
            row = {OURS: SMAD, STILL: "without velocity encoding"}.get(method)
            printed = SMAD_5.at((row, kind), "PSNR").value if row else None
            cells = [pooled(found[method][kind], metric) for metric in ("PSNR", "LPIPS", "loose")]
            rows.append([run.parent.name, kind, method, printed, *cells, growth(found[method][kind][0]["PSNR"])])
    return Table(
        "Long takes (SMAD Table 5)",
        f"{smad_motions.LONG} frames under the keyboard: keys that change (dynamic), one key held (repetitive); "
        "otherwise as in the table of deformers. Growth: the slope of PSNR, dB in 1,000 frames. The paper's are of "
        "other subjects.",
        ["avatar", "take", "method", "paper's PSNR", "PSNR", "LPIPS", "loose nodes, mm", "growth"],
        rows,
    )


def pooled(takes: list[Values], metric: str) -> Estimate | None:
    """The mean over the measured frames of takes; its interval is over pieces of them. None where nothing is known."""
    if not takes or metric not in takes[0]:
        return None
    return bootstrap(np.concatenate([take[metric] for take in takes]), _pieces(takes, metric))


def less(first: list[Values], second: list[Values], metric: str) -> Estimate:
    """By how much the first is higher, frame by frame."""
    apart = [np.subtract(a[metric], b[metric]) for a, b in zip(first, second, strict=True)]
    return bootstrap(np.concatenate(apart), _pieces(first, metric))


def growth(values: list[float]) -> Estimate:
    """The slope of the values of measured frames, in 1,000 frames."""
    line = drift.trend(np.asarray(values), block=2 * PIECE // measures.EVERY)
    slope, low, high = (1000 / measures.EVERY * x for x in (line.slope, *line.slope_interval))
    return Estimate(slope, low, high, len(values))


def order(found: dict[str, list[Values]]) -> str:
    """How many pairs of methods are told apart in PSNR, and how many of these are in the paper's order."""
    pairs, told, same = 0, 0, 0
    for first, second in itertools.combinations(found, 2):
        printed = METHODS[first][1], METHODS[second][1]
        if printed[0] is None or printed[1] is None or printed[0] == printed[1]:
            continue
        apart = less(found[first], found[second], "PSNR")
        pairs += 1
        if apart.low > 0 or apart.high < 0:
            told, same = told + 1, same + ((printed[0] > printed[1]) == (apart.mean > 0))
    return f"of {pairs} pairs of methods {told} are told apart, {same} of these in the paper's order"


def _pieces(takes: list[Values], metric: str) -> np.ndarray:
    """To which piece of which take every measured frame belongs."""
    size = PIECE // measures.EVERY
    return np.concatenate([1000 * k + np.arange(len(take[metric])) // size for k, take in enumerate(takes)])


def _known(nodes: np.ndarray | None) -> np.ndarray:
    assert nodes is not None, "takes of avatars of ours are filmed with their meshes"
    return nodes


@functools.cache
def perceptual() -> lpips.Network | None:
    """The network of LPIPS, read once, where it is there."""
    return lpips.load("alex") if pretrained.available("alex") else None
