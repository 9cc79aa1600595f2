"""Which key is held in which frame: actions as names or ids, from an argument, an actions file, or a folder's name."""

from __future__ import annotations

import csv
import json
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

NAMES = ("idle", "forward", "backward", "left", "right")
FILES = ("actions.csv", "actions.json")


def action_id(action: typing.Any, names: Sequence[str], source: str | Path) -> int:
    """The id of an action given as a name, whatever its case, or as an id; ValueError lists the known actions."""
    text = str(action).strip()
    lower = [name.lower() for name in names]
    if text.lower() in lower:
        return lower.index(text.lower())
    if text.isdecimal() and int(text) < len(names):
        return int(text)
    known = ", ".join(f"{k} {name}" for k, name in enumerate(names))
    raise ValueError(f"{source}: unknown action {action!r}: known are {known}; others go into action_names")


def resolve(
    actions: typing.Any, names: Sequence[str], series: Mapping[str, Sequence[int]], source: str | Path
) -> dict[str, Int[np.ndarray, "_f"]]:
    """Action ids (f,) of each sequence; `series` holds the frame numbers of each sequence by its name.

    `actions` is one action for everything; a list for the only sequence, or for all of them joined; a mapping of
    sequence names to either; or the path of an actions file (`read_actions`). Raises ValueError for an unknown action,
    another number of actions than frames, or a sequence without actions.
    """
    if isinstance(actions, Path) or (isinstance(actions, str) and Path(actions).suffix.lower() in (".csv", ".json")):
        return read_actions(Path(actions), names, series)
    if isinstance(actions, str | int | np.integer):
        one = action_id(actions, names, source)
        return {name: np.full(len(numbers), one, np.int32) for name, numbers in series.items()}
    if isinstance(actions, Mapping):
        _same_sequences(actions, series, source)
        parts = {}
        for name, numbers in series.items():
            parts.update(resolve(actions[name], names, {name: numbers}, f"{source}, sequence {name}"))
        return parts
    ids = np.array([action_id(action, names, source) for action in actions], np.int32)
    ends = np.cumsum([len(numbers) for numbers in series.values()])
    if len(ids) != ends[-1]:
        raise ValueError(f"{source}: {len(ids)} actions for {ends[-1]} frames: give one action for each frame")
    return dict(zip(series, np.split(ids, ends[:-1]), strict=True))


def read_actions(
    path: Path, names: Sequence[str], series: Mapping[str, Sequence[int]]
) -> dict[str, Int[np.ndarray, "_f"]]:
    """Action ids (f,) of each sequence from a file, as `resolve`.

    CSV: a header `frame,action` or `sequence,frame,action`, and one row for each frame; frames are counted as the
    frame files are, or from 0. JSON: a list of actions, or an object of such lists by sequence name.
    """
    if not path.is_file():
        raise ValueError(f"{path} does not exist: give the path of an actions file, or the actions themselves")
    try:
        text = path.read_text(encoding="utf-8-sig")
        if path.suffix.lower() == ".json":
            content = json.loads(text)
        else:
            rows = list(csv.DictReader(text.splitlines(), skipinitialspace=True))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path} cannot be read as {path.suffix[1:]} ({error}): write it again as UTF-8") from error
    if path.suffix.lower() == ".json":
        lists = content.values() if isinstance(content, dict) else [content]
        if not all(isinstance(each, list) for each in lists):
            raise ValueError(f"{path} must hold a list of actions, or an object of such lists by sequence name")
        return resolve(content, names, series, path)

    columns = set(rows[0]) if rows else set()
    if not {"frame", "action"} <= columns:
        raise ValueError(f"{path} needs a header frame,action or sequence,frame,action and one row for each frame")
    if "sequence" not in columns and len(series) > 1:
        raise ValueError(f"{path} needs a column sequence: there are the sequences {', '.join(series)}")
    only = next(iter(series))
    tables: dict[str, dict[int, str]] = {}
    for line, row in enumerate(rows, 2):
        name = row["sequence"] if "sequence" in columns else only
        frame, table = (row["frame"] or "").strip(), tables.setdefault(name, {})
        if not frame.isdecimal() or int(frame) in table:
            raise ValueError(f"{path}, line {line}: frame {frame!r} must be a whole number that occurs once")
        table[int(frame)] = row["action"]
    _same_sequences(tables, series, path)
    return {name: _in_order(tables[name], numbers, names, f"{path}, {name}") for name, numbers in series.items()}


def _in_order(table: dict[int, str], numbers: Sequence[int], names: Sequence[str], source: str) -> np.ndarray:
    counted = range(len(numbers)) if set(table) == set(range(len(numbers))) else numbers
    missing, extra = sorted(set(counted) - set(table)), sorted(set(table) - set(counted))
    if missing or extra:
        found = f"frame {missing[0]} has no action" if missing else f"there is no frame {extra[0]}"
        raise ValueError(f"{source}: {len(table)} actions for {len(numbers)} frames, {found}: one row for each frame")
    return np.array([action_id(table[frame], names, f"{source}, frame {frame}") for frame in counted], np.int32)


def _same_sequences(found: Mapping, series: Mapping, source: str | Path) -> None:
    if set(found) != set(series):
        raise ValueError(
            f"{source} has actions of the sequences {', '.join(map(str, found))}; there are {', '.join(series)}: name "
            "every sequence once"
        )
