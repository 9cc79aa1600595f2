"""Trained avatars as files: one safetensors file with every array, its config in the header."""

from __future__ import annotations

import dataclasses
import os
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from avatarjax.io import weights
from avatarjax.posmap import Atlas, build_upscaler, tangents
from avatarjax.posmap.pca import PCA
from avatarjax.unica.appearance import BaseAttributes
from avatarjax.unica.avatar import Avatar
from avatarjax.unica.coefficients import CoefficientDynamics, Scaling
from avatarjax.unica.config import PRESETS, DynamicsName, UnicaConfig
from avatarjax.unica.latent import LatentDynamics
from avatarjax.unica.stance import Stance

VERSION = 2
SHIPPED = Path(__file__).parent.parent / "assets" / "avatars"
# Stored in half precision on request: what is learned. The atlas, in which half a millimetre counts, is not.
_LEARNED = ("pca", "base", "appearance", "dynamics")


def file_name(dynamics: str) -> str:
    """Name of an avatar's file inside a run folder."""
    return f"avatar-{dynamics}.safetensors"


def save(path: str | os.PathLike, avatar: Avatar, *, half: bool = False, **metadata: typing.Any) -> None:
    """Write an avatar atomically; `half` stores what was learned as float16. Upscaler and tangents are not stored:
    they follow from the atlas. `metadata`, as JSON, goes into the header."""
    tree = {
        f.name: getattr(avatar, f.name)
        for f in dataclasses.fields(avatar)
        if f.name not in ("upscaler", "tangents", "config") and getattr(avatar, f.name) is not None
    }
    if half:
        tree |= {name: jax.tree.map(_halve, tree[name]) for name in _LEARNED if name in tree}
    weights.save_tree(path, tree, **metadata, version=VERSION, config=dataclasses.asdict(avatar.config))


def shipped() -> dict[str, Path]:
    """The trained avatars that come with the package, by name: `small` ones, made by `experiments.ship`."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.safetensors"))}


def _halve(x: jax.Array) -> jax.Array:
    return x.astype(jnp.float16) if x.dtype == jnp.float32 else x


def load(
    source: str | os.PathLike, *, dynamics: DynamicsName | None = None, runs: str | os.PathLike = "runs"
) -> Avatar:
    """A trained avatar from a file, a run folder, or by name: your own from `experiments.unica`, or a shipped one.

    By name, presets are searched from the largest to the smallest under `runs`/unica/NAME/, then what the package ships
    (`shipped`). `dynamics` asks for one of the two models; otherwise the coefficient model is taken where a run has
    both. Raises ValueError where nothing is there, with the command that trains it, and for files that are damaged or
    of another version.
    """
    path = Path(source)
    if path.is_file():
        return _read(path)
    folders = [path]
    if path.name == str(source):
        folders += [Path(runs) / "unica" / path.name / preset for preset in reversed(PRESETS)]
    for folder in folders:
        for name in (dynamics,) if dynamics else typing.get_args(DynamicsName):
            if (folder / file_name(name)).is_file():
                return _read(folder / file_name(name))
    known = shipped()
    if str(source) in known and dynamics in (None, "coefficients"):
        return _read(known[str(source)])
    raise ValueError(
        f"no trained avatar {str(source)!r}: neither a file, nor a run folder, nor under {Path(runs) / 'unica'}, nor "
        f"shipped ({', '.join(known) or 'none is'}). "
        f"Train it with: python -m experiments.unica --avatar {path.name} --train"
    )


def _read(path: Path) -> Avatar:
    arrays, metadata = weights.load_arrays(path)
    if metadata.get("version") != VERSION:
        raise ValueError(f"{path} holds no avatar of version {VERSION}: train it again, with --train")
    try:
        config = weights.from_dict(UnicaConfig, metadata["config"])
        arrays = {k: v.astype(np.float32) if v.dtype == np.float16 else v for k, v in arrays.items()}
        tree = weights.nest({name: jnp.asarray(value) for name, value in arrays.items()})
        dynamics = tree["dynamics"]
        if "vae" in dynamics:
            dynamics = LatentDynamics(**dynamics)
        else:
            parts: dict[str, typing.Any] = {"basis": PCA, "scaling": Scaling, "stance": Stance}
            made = {name: cls(**dynamics[name]) for name, cls in parts.items() if name in dynamics}
            dynamics = CoefficientDynamics(**(dynamics | made))
        atlas = Atlas(**tree["atlas"], size=config.size)
        return Avatar(
            atlas=atlas,
            upscaler=build_upscaler(atlas, config.upscaled),
            tangents=tangents(atlas),
            pca=PCA(**tree["pca"]) if isinstance(dynamics, LatentDynamics) else None,
            base=BaseAttributes(**tree["base"]),
            appearance=tree["appearance"],
            dynamics=dynamics,
            standing=tree["standing"],
            config=config,
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path} lacks parts of an avatar ({error}): train it again") from error
