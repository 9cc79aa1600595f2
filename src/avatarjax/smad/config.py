"""Sizes and numbers of a SMAD run, as frozen dataclasses with presets by name.

Presets run the same code with different numbers: `ci` in minutes on two CPU cores, `small` is the default on a CPU,
`base` and `paper` have the paper's sizes. A comment says whose a value is where it is not the paper's.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable

from avatarjax.smad.graph import GraphConfig
from avatarjax.smad.hull import HullConfig
from avatarjax.smad.refine import RefineConfig
from avatarjax.train import StageConfig


def _seeds(names: tuple[str, ...], seeds: tuple[int, ...]) -> tuple[tuple[str, int], ...]:
    return tuple((name, seed) for seed in seeds for name in names)


Aggregation = typing.Literal["mean", "adjacency"]
Motion = typing.Literal["springs", "deltas"]
PresetName = typing.Literal["ci", "small", "base", "paper"]


@dataclasses.dataclass(frozen=True)
class FilmConfig:
    """What is filmed of an avatar of ours, in pictures of so many pixels with so many steps of the cloth a frame. Ours.

    Takes are (performance, seed). The first of `train` is that of the canonical pose: a slow turn. `test` has other
    seeds of performances that were trained on, `unseen` performances that were not (SMAD Table 3).
    """

    size: int = 512
    substeps: int = 32
    train: tuple[tuple[str, int], ...] = (("turn", 0), *_seeds(("arcs", "spins", "dance"), (0, 1, 2)))
    test: tuple[tuple[str, int], ...] = _seeds(("arcs", "spins", "dance"), (3,))
    unseen: tuple[tuple[str, int], ...] = _seeds(("kicks", "jumps"), (0,))


@dataclasses.dataclass(frozen=True)
class DeformerConfig:
    """The deformation network (SMAD 3.2, B.2, Tables G and H), and what of it an ablation switches off.

    Rows of Tables 2 and 4: `velocities` is tau_v + 1, so 0 is B0 and 2 is B1; `adaptive_stiffness=False` before A2,
    `edge_features=False` before A3 (the vanilla GNN, whose messages are of two hidden states alone), `codes=0` before
    A4; with `iterations=0` no node hears of another, which is the MLP deformer.
    """

    pose: int = 72  # ours: numbers of one body pose, as SMPL's 24 axis-angle joints have
    pose_window: int = 8  # ours: poses in the window, tau + 1
    pose_stride: int = 2  # ours: frames from one of them to the next
    pose_width: int = 256
    pose_embedding: int = 128
    velocities: int = 12  # of each node, newest first: tau_v + 1
    node_features: int = 0  # ours: further numbers of each node
    hidden: int = 256
    message: int = 128
    iterations: int = 3
    aggregation: Aggregation = "mean"  # B.2; "adjacency" is Eq. 5
    edge_features: bool = True
    strain: bool = False  # ours: how far an edge is stretched, metres, as one more feature of it
    adaptive_stiffness: bool = True  # a learned k_ij for each edge; ours: it weighs the messages
    decoder: tuple[int, int] = (256, 128)
    codes: int = 16  # ours: length of each Gaussian's latent code z_i; 0: none

    def __post_init__(self):
        for name in ("pose", "pose_window", "pose_stride", "pose_width", "pose_embedding", "hidden", "message"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be positive")
        for name in ("velocities", "node_features", "iterations", "codes"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must not be negative")
        if self.aggregation not in typing.get_args(Aggregation):
            known = ", ".join(typing.get_args(Aggregation))
            raise ValueError(f"unknown aggregation {self.aggregation!r}: choose one of {known}")
        if self.strain and not self.edge_features:
            raise ValueError("strain is a feature of an edge: it needs edge_features")

    @property
    def pose_span(self) -> int:
        """Frames from the oldest to the newest pose of the window, both counted."""
        return (self.pose_window - 1) * self.pose_stride + 1

    @property
    def node_inputs(self) -> int:
        """Numbers of one node that enter the projection, its pose embedding not among them."""
        return 3 + 3 * self.velocities + self.node_features

    @property
    def edge_inputs(self) -> int:
        """Numbers of one directed edge; 519 as published."""
        geometry = 3 + 3 * (self.velocities > 0) + 1 + self.strain
        return 2 * self.hidden + geometry * self.edge_features


@dataclasses.dataclass(frozen=True)
class DynamicsConfig:
    """How the dynamics are learned from tracks; from those of videos the equilibrium alone, and the rest from pictures
    (`PicturesConfig`). All is ours.

    components: of the offsets, whose kernel ridge regression from the pose window and from how they were `memory`
    frames before (0: from the window alone; with so much `ridge` and so many `centres`, `drape.fit`) is the drape that
    the equilibrium departs from; 0: none.
    target_stage: of what poses alone say of the offsets, which needs no rollouts, in frames; stage: of all else, in
    rollouts of so many `frames`. noise: of the offsets from which rollouts start, in units of the
    offsets' spread, constant over the history. isometry, damping: weights of Eq. 11, means over edges and nodes.

    The paper's weights, 0.1 and 0.01, are for sums in its own units: in units of the offsets' spread they take true
    folds for stretch (docs/smad.md).
    """

    components: int = 48
    memory: int = 8
    ridge: float = 0.03
    centres: int = 3_000
    frames: int = 12
    noise: float = 0.05
    isometry: float = 0.001
    damping: float = 0.0001
    target_stage: StageConfig = StageConfig(6_000, 64, 1e-3)
    stage: StageConfig = StageConfig(2_000, 8, 1e-3)


@dataclasses.dataclass(frozen=True)
class PicturesConfig:
    """How they are learned from pictures. All but the photometric loss (Eq. 10) is ours.

    drape_stage: of the equilibrium and the Gaussians, in frames; swing_stage: of the dynamics, in rollouts of so many
    `frames`, of each of which so many are `drawn`. silhouette, isometry, offset: weights beside the photometric error.
    """

    drape_stage: StageConfig = StageConfig(20_000, 2, 2e-3)
    swing_stage: StageConfig = StageConfig(2_000, 4, 3e-4)
    frames: int = 12
    drawn: int = 3
    silhouette: float = 0.3
    isometry: float = 0.03
    offset: float = 0.05


@dataclasses.dataclass(frozen=True)
class SmadConfig:
    """A whole run.

    motion: "springs" is Eq. 4, the Euler step of a mass-spring-damper whose acceleration the network adds to; "deltas"
    is B.2, where the network says directly how far a node is from its equilibrium, and refines its velocity.
    equilibrium: ours, offsets that a window of poses (and the drape's memory) determines; without it all motion is the
    system's, as in the paper.
    """

    film: FilmConfig = FilmConfig()
    hull: HullConfig = HullConfig(resolution=256, gaussians=60_000)
    refine: RefineConfig = RefineConfig(steps=20_000)
    graph: GraphConfig = GraphConfig()
    deformer: DeformerConfig = DeformerConfig()
    dynamics: DynamicsConfig = DynamicsConfig()
    pictures: PicturesConfig = PicturesConfig()
    motion: Motion = "springs"
    equilibrium: bool = True
    dt: float = 1 / 30  # seconds a frame

    def __post_init__(self):
        if self.motion not in typing.get_args(Motion):
            known = ", ".join(typing.get_args(Motion))
            raise ValueError(f"unknown motion {self.motion!r}: choose one of {known}")


def _small() -> SmadConfig:
    return SmadConfig(
        film=FilmConfig(size=256),
        hull=HullConfig(gaussians=6_000),
        refine=RefineConfig(),
        graph=GraphConfig(nodes=2_000),
        deformer=DeformerConfig(
            pose_width=128, pose_embedding=64, hidden=128, message=64, decoder=(128, 64), codes=8, strain=True
        ),
        pictures=PicturesConfig(
            drape_stage=StageConfig(8_000, 2, 2e-3), swing_stage=StageConfig(100, 2, 3e-4), frames=8, drawn=2
        ),
    )


def _ci() -> SmadConfig:
    return SmadConfig(
        film=FilmConfig(
            size=96,
            substeps=8,
            train=(("turn", 0), *_seeds(("arcs", "dance"), (0,))),
            test=(("arcs", 1),),
            unseen=(("kicks", 0),),
        ),
        hull=HullConfig(resolution=64, frames=60, gaussians=1_500),
        refine=RefineConfig(steps=5_000),
        graph=GraphConfig(nodes=300, neighbours=8),
        deformer=DeformerConfig(
            pose_width=64, pose_embedding=32, hidden=64, message=32, decoder=(64, 32), codes=4, strain=True
        ),
        dynamics=DynamicsConfig(
            frames=16,
            target_stage=StageConfig(2_000, 64, 3e-3),
            stage=StageConfig(300, 4, 5e-4),
        ),
        pictures=PicturesConfig(
            drape_stage=StageConfig(4_000, 2, 2e-3), swing_stage=StageConfig(40, 4, 3e-4), frames=8, drawn=2
        ),
    )


PRESETS: dict[str, Callable[[], SmadConfig]] = {
    "ci": _ci,
    "small": _small,
    "base": SmadConfig,
    "paper": SmadConfig,
}


def preset(name: str, **changes: typing.Any) -> SmadConfig:
    """The preset of this name with fields replaced; ValueError that lists the names for an unknown one."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset {name!r}: choose one of {', '.join(PRESETS)}")
    return dataclasses.replace(PRESETS[name](), **changes)
