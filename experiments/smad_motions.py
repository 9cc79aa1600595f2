"""Where the clothes of a simulated avatar truly are: tracks of points of its mesh, for dynamics to be learned from.

No camera is involved. What comes of such tracks is what SMAD's dynamics can do where everything is seen.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from tqdm import tqdm

from avatarjax.data import avatars, capture, dressing, sequences
from avatarjax.data.body import Rig
from avatarjax.data.motion import clips, locomotion, performances
from avatarjax.data.motion.locomotion import Motion
from avatarjax.data.wardrobe.assembly import AvatarMesh
from avatarjax.io import weights
from avatarjax.physics.xpbd import XPBDConfig
from avatarjax.smad import driving, graph, skeletal
from avatarjax.smad.driving import Pose
from avatarjax.smad.graph import Graph, GraphConfig
from avatarjax.smad.skeletal import Skin
from avatarjax.smad.train_dynamics import Take

KEPT = 2_000  # points of the mesh that are kept of every frame
LONG = 960  # frames of a long sequence, over 30 seconds (SMAD Table 5)
KEYBOARD = ("keys", "run")  # long sequences; all other motions are performances
JITTER = 5e-4  # metres by which the body of a twin trembles
TWIN = "twin"

Name = tuple[str, int]  # of a motion, and its seed


@dataclasses.dataclass(frozen=True)
class Motions:
    """Which motions are learned from, and on which of them is measured; all are (performance, seed).

    test: other seeds of performances that were learned from; unseen: performances that were not (SMAD Table 3); long:
    "keys" and "run" under the keyboard, LONG frames each (SMAD Table 5: a dynamic and a repetitive sequence).
    """

    train: tuple[Name, ...] = tuple((name, seed) for seed in range(24) for name in ("arcs", "dance", "spins"))
    test: tuple[Name, ...] = tuple((name, seed) for seed in (100, 101) for name in ("arcs", "dance", "spins"))
    unseen: tuple[Name, ...] = tuple((name, seed) for seed in (0, 1) for name in ("kicks", "jumps"))
    long: tuple[Name, ...] = (("keys", 0), ("run", 0))

    def learning(self, count: int) -> Motions:
        """The same, but to learn from the first so many alone."""
        return dataclasses.replace(self, train=self.train[:count])


class Stage:
    """An avatar and how it was simulated, kept in a folder."""

    def __init__(self, folder: Path, avatar: str, substeps: int):
        self.folder, self.name, self.config = folder, avatar, XPBDConfig(substeps=substeps)

    @functools.cached_property
    def avatar(self) -> AvatarMesh:
        """Its mesh, which takes seconds to build."""
        return avatars.build(self.name)

    @property
    def rig(self) -> Rig:
        """Its skeleton."""
        return self.avatar.rig

    @functools.cached_property
    def canonical(self) -> tuple[Pose, Float[np.ndarray, "v 3"], Int[np.ndarray, " k"]]:
        """The first pose of the slow turn, the vertices there in its body frame, and which of them are kept."""
        motion = perform(self.rig, ("turn", 0))
        first = jax.tree.map(lambda x: x[:1], motion)
        vertices = dressing.simulate(self.avatar, first.transforms, self.config)
        pose = driving.recorded(capture.poses_of(self.rig, first))
        rest = np.asarray(driving.to_body(pose, jnp.asarray(vertices)))[0]
        return jax.tree.map(lambda x: x[0], pose), rest, thinned(rest, KEPT)

    def tracks(self, name: Name, twin: bool = False) -> Take:
        """Where the kept points are in a motion, simulated where it has not been yet. A twin's body trembles by half a
        millimetre, which no one could see: how far its cloth then is from the other's cannot be predicted."""
        path = self.folder / f"{name[0]}-{name[1]}{'-' + TWIN if twin else ''}.safetensors"
        motion = perform(self.rig, name)
        poses = driving.recorded(capture.poses_of(self.rig, motion))
        if not path.is_file():
            transforms = np.array(motion.transforms)
            if twin:
                transforms[..., 3] += JITTER * np.random.default_rng(name[1]).normal(size=(len(transforms), 1, 3))
            with tqdm(total=len(transforms), desc=path.stem, unit="frame") as bar:
                vertices = dressing.simulate(self.avatar, transforms, self.config, progress=bar.update)
            kept = driving.to_body(poses, jnp.asarray(vertices[:, self.canonical[2]]))
            path.parent.mkdir(parents=True, exist_ok=True)
            weights.save_tree(path, {"points": np.asarray(kept, np.float16)})
        return Take(poses, jnp.asarray(weights.load_arrays(path)[0]["points"], jnp.float32))

    def nodes(self, config: GraphConfig) -> tuple[Graph, Skin, Int[np.ndarray, " n"]]:
        """A graph of about so many of the kept points, their skinning, and which of the kept points they are."""
        pose, rest, kept = self.canonical
        chosen = thinned(rest[kept], config.nodes)
        found = graph.build(rest[kept][chosen], config.neighbours, config.bandwidth)
        return found, skeletal.bind(self.rig, pose, found.positions), chosen


def length(name: Name) -> int:
    """Frames of a motion."""
    return LONG if name[0] in KEYBOARD else performances.frame_count(name[0])


def perform(rig: Rig, name: Name) -> Motion:
    """A performance, or a long sequence under the keyboard."""
    kind, seed = name
    if kind not in KEYBOARD:
        return jax.device_get(performances.perform(rig, kind, seed))
    actions = np.full(LONG, sequences.ACTIONS.index("forward"), np.int32)
    if kind == "keys":
        actions = np.concatenate(sequences.chain_scripts(None, seed))[:LONG]
    config = locomotion.LocomotionConfig()
    looping = clips.load_clips(rig, config.emotes)
    return jax.device_get(locomotion.simulate(rig, looping, jnp.asarray(actions), jax.random.key(seed), config))


def thinned(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " m"]:
    """About so many of the points, one in each voxel of a grid (SMAD B.1)."""
    if count >= len(points):
        return np.arange(len(points))
    return graph.downsample(points, np.zeros(len(points)), graph.edge_for_count(points, count)).kept


def on_nodes(take: Take, chosen: Int[np.ndarray, " n"]) -> Take:
    """The take of some of its points alone."""
    return take.replace(positions=take.positions[:, chosen])


def all_of(motions: Motions) -> dict[str, tuple[Name, ...]]:
    """The motions of each part."""
    return typing.cast(dict[str, tuple[Name, ...]], dataclasses.asdict(motions))
