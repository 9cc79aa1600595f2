"""The public UNICA position-map groups as one array in our axes: `{sequence}_{index:05d}_{Action}/{1..4}.exr`."""

from __future__ import annotations

import dataclasses
import os
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from avatarjax.data.importers import actions, series
from avatarjax.posmap import groups


@typing.no_type_check
@dataclasses.dataclass(frozen=True, eq=False)
class PositionMapSequence:
    """g groups of four position maps of one avatar, in our axes, group-normalised, in the order of the sequences.

    maps (g, 4, h, w, 3) with background 0; mask (h, w) is the avatar's foreground; labels (g,) the action of the third
    frame, ids into action_names; sequence (g,) index into sequence_names; index (g,) as in the folder's name.
    """

    maps: Float[np.ndarray, "g 4 h w 3"]
    mask: Bool[np.ndarray, "h w"]
    labels: Int[np.ndarray, " g"]
    action_names: tuple[str, ...]
    sequence: Int[np.ndarray, " g"]
    sequence_names: tuple[str, ...]
    index: Int[np.ndarray, " g"]
    source: str


def load_position_maps(path: str | os.PathLike, *, action_names: Sequence[str] = actions.NAMES) -> PositionMapSequence:
    """Load a folder of public groups of one avatar, or a single group.

    Raises ValueError that names the folder for no groups, several avatars, an unknown action, a damaged file, or
    groups of different size or foreground.
    """
    path = Path(path)
    if not path.is_dir():
        raise ValueError(f"{path} is not a folder: give one of groups such as 0-w_00001_Idle")
    folders = [path] if (path / "1.exr").is_file() else [p for p in path.iterdir() if (p / "1.exr").is_file()]
    if not folders:
        avatars = sorted({p.parent.parent.name for p in path.glob("*/*/1.exr")})
        hint = (
            f": choose one avatar of {', '.join(avatars)}" if avatars else ": expected 0-w_00001_Idle/1.exr and so on"
        )
        raise ValueError(f"{path} holds no position-map groups{hint}")
    named = sorted(
        ((*groups.parse_group_name(folder.resolve().name), folder) for folder in folders),
        key=lambda entry: (series.natural_key(entry[0]), entry[1]),
    )
    maps, labels, mask = [], [], None
    for _, _, action, folder in named:
        ours, masks = groups.from_public(groups.read_group(folder))
        mask = masks[0] if mask is None else mask
        if masks[0].shape != mask.shape or (masks[0] != mask).any():
            raise ValueError(f"{folder} has another size or foreground than {named[0][3]}: keep avatars in own folders")
        maps.append(ours)
        labels.append(actions.action_id(action, action_names, folder))
    names = list(dict.fromkeys(entry[0] for entry in named))
    assert mask is not None
    return PositionMapSequence(
        maps=np.stack(maps),
        mask=mask,
        labels=np.array(labels, np.int32),
        action_names=tuple(action_names),
        sequence=np.array([names.index(entry[0]) for entry in named], np.int32),
        sequence_names=tuple(names),
        index=np.array([entry[1] for entry in named], np.int32),
        source=str(path),
    )
