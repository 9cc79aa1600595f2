"""Groups of four frames in the public UNICA file layout: `{sequence}_{index:05d}_{Action}/{1,2,3,4}.exr`.

The files hold float32 RGB, already group-normalised, with background 0. Their world is z-up with the figure facing
-y, and the channels are stored in reverse, (R, G, B) = (z, y, x). `read_group` and `write_group` move the raw
arrays bit for bit; `from_public` and `to_public` change the axes to ours and back.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from avatarjax.io import exr

FRAMES = 4
_NAME = re.compile(r"(?P<sequence>.+)_(?P<index>\d{5})_(?P<action>[^_]+)")


def group_name(sequence: str, index: int, action: str) -> str:
    """Folder name of a group; the action is that of its third frame."""
    return f"{sequence}_{index:05d}_{action}"


def parse_group_name(name: str) -> tuple[str, int, str]:
    """(sequence, index, action) of a folder name; ValueError where it is not one."""
    match = _NAME.fullmatch(name)
    if match is None:
        raise ValueError(f"{name!r} is not a group folder: expected SEQUENCE_00000_Action")
    return match["sequence"], int(match["index"]), match["action"]


def read_group(folder: str | os.PathLike) -> Float[np.ndarray, "4 h w 3"]:
    """The raw arrays of a group's four files.

    Raises ValueError that names the missing or unreadable file, or the frame whose size or foreground differs.
    """
    maps = [exr.read_exr(Path(folder) / f"{frame}.exr") for frame in range(1, FRAMES + 1)]
    for frame, one in enumerate(maps, 1):
        if one.shape != maps[0].shape or one.shape[-1] != 3:
            raise ValueError(f"{folder}/{frame}.exr has shape {one.shape}, expected {(*maps[0].shape[:2], 3)}")
        if not np.isfinite(one).all():
            raise ValueError(f"{folder}/{frame}.exr holds a value that is not finite")
    raw = np.stack(maps)
    for frame, foreground in enumerate((raw != 0).any(-1), 1):
        if (foreground != (raw[0] != 0).any(-1)).any():
            raise ValueError(f"{folder}/{frame}.exr has another foreground than 1.exr: not one avatar's group")
    return raw


def write_group(folder: str | os.PathLike, raw: Float[np.ndarray, "4 h w 3"]) -> None:
    """Write the raw arrays of a group, each file atomically and without loss."""
    for frame, one in enumerate(raw, 1):
        exr.write_exr(Path(folder) / f"{frame}.exr", one)


def from_public(raw: Float[np.ndarray, "*f h w 3"]) -> tuple[Float[np.ndarray, "*f h w 3"], Bool[np.ndarray, "*f h w"]]:
    """Raw public maps in our axes (y up, facing +z; background 0) and their foreground masks; exact to 1e-7."""
    mask = (raw != 0).any(-1)
    ours = np.stack([raw[..., 2], raw[..., 0], 1 - raw[..., 1]], -1)
    return np.where(mask[..., None], ours, 0).astype(np.float32), mask


def to_public(posmap: Float[np.ndarray, "*f h w 3"], mask: Bool[np.ndarray, "*f h w"]) -> Float[np.ndarray, "*f h w 3"]:
    """Our normalised maps in the public axes and channel order; the inverse of `from_public` to 1e-7."""
    raw = np.stack([posmap[..., 1], 1 - posmap[..., 2], posmap[..., 0]], -1)
    return np.where(mask[..., None], raw, 0).astype(np.float32)
