"""Avatars, their motion, ground-truth pictures, datasets made from them, and the door for everybody's own data."""

from __future__ import annotations

import typing

if typing.TYPE_CHECKING:
    from avatarjax.data.importers import (
        GaussianScene,
        MeshSequence,
        MonocularVideo,
        Poses,
        PositionMapSequence,
        SkeletonAnimation,
        load_gaussian_scene,
        load_gltf_animation,
        load_mesh_sequence,
        load_monocular,
        load_position_maps,
        write_monocular,
    )

__all__ = [
    "GaussianScene",
    "MeshSequence",
    "MonocularVideo",
    "Poses",
    "PositionMapSequence",
    "SkeletonAnimation",
    "load_gaussian_scene",
    "load_gltf_animation",
    "load_mesh_sequence",
    "load_monocular",
    "load_position_maps",
    "write_monocular",
]


def __getattr__(name: str) -> typing.Any:
    """The importers' names, imported when they are first asked for: importing this package stays cheap."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from avatarjax.data import importers

    return getattr(importers, name)
