"""Trained SMAD avatars as files: one safetensors file with every array, config and skeleton's names in the header."""

from __future__ import annotations

import dataclasses
import os
import typing
from pathlib import Path

import jax.numpy as jnp

from avatarjax.data.body import Rig
from avatarjax.gaussians import Gaussians
from avatarjax.io import weights
from avatarjax.smad.avatar import Avatar
from avatarjax.smad.config import PRESETS, SmadConfig
from avatarjax.smad.drape import Drape
from avatarjax.smad.dynamics import Known, Scaling, System
from avatarjax.smad.embedded import Binding
from avatarjax.smad.graph import Graph
from avatarjax.smad.kernel import Kernel
from avatarjax.smad.skeletal import Skin

VERSION = 5
FILE = "avatar.safetensors"


def save(path: str | os.PathLike, avatar: Avatar, **metadata: typing.Any) -> None:
    """Write an avatar atomically; `metadata`, as JSON, goes into the header."""
    skin = avatar.system.skin
    skeleton = None if skin is None else {"names": skin.rig.names, "parents": skin.rig.parents}
    tree = {f.name: getattr(avatar, f.name) for f in dataclasses.fields(avatar) if f.name != "config"}
    described = {"version": VERSION, "config": dataclasses.asdict(avatar.config), "skeleton": skeleton}
    weights.save_tree(path, tree, **metadata, **described)


def load(source: str | os.PathLike, *, runs: str | os.PathLike = "runs") -> Avatar:
    """A trained avatar from a file, a run folder, or by name, from the largest preset to the smallest under
    `runs`/smad/NAME/.

    Raises ValueError where nothing is there, with the command that trains it, and for files that are damaged or of
    another version.
    """
    path = Path(source)
    if path.is_file():
        return _read(path)
    folders = [path]
    if path.name == str(source):
        folders += [Path(runs) / "smad" / path.name / preset for preset in reversed(PRESETS)]
    for folder in folders:
        if (folder / FILE).is_file():
            return _read(folder / FILE)
    raise ValueError(
        f"no trained avatar {str(source)!r}: neither a file, nor a run folder, nor under {Path(runs) / 'smad'}. "
        f"Train it with: python -m experiments.smad --avatar {path.name}"
    )


def _read(path: Path) -> Avatar:
    arrays, metadata = weights.load_arrays(path)
    if metadata.get("version") != VERSION or "skeleton" not in metadata:
        raise ValueError(f"{path} holds no SMAD avatar of version {VERSION}: train it again")
    try:
        config = weights.from_dict(SmadConfig, metadata["config"])
        tree = weights.nest({name: jnp.asarray(value) for name, value in arrays.items()})
        system, skin = tree["system"], None
        if metadata["skeleton"] is not None:
            names, parents = (tuple(metadata["skeleton"][part]) for part in ("names", "parents"))
            skin = Skin(Rig(**system["skin"]["rig"], names=names, parents=parents), system["skin"]["basis"])
        drape, known = system.get("drape"), system.get("known")
        return Avatar(
            gaussians=Gaussians(**tree["gaussians"]),
            binding=Binding(**tree["binding"]),
            system=System(
                Graph(**system["graph"]),
                skin,
                Scaling(**system["scaling"]),
                None if drape is None else Drape(**drape | {"kernel": Kernel(**drape["kernel"])}),
                None if known is None else Known(**known | {"kernel": Kernel(**known["kernel"])}),
            ),
            params=tree["params"],
            config=config,
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} lacks parts of an avatar ({error}): train it again") from error
