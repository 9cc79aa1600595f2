"""Numbered files in natural order, and names inside files that must not lead out of the imported folder."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

_DIGITS = re.compile(r"(\d+)")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """A sort key under which frame2 comes before frame10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in _DIGITS.split(name) if part]


def natural_order(paths: Iterable[Path]) -> list[Path]:
    """Paths by name, numbers by value."""
    return sorted(paths, key=lambda path: natural_key(path.name))


def frame_numbers(paths: Sequence[Path]) -> tuple[int, ...]:
    """The frame numbers of one series of files in natural order: the last number in each name.

    A single file without a number is frame 0. Raises ValueError that names the file for a name without a number, two
    series in one folder, a number that occurs twice, and the first number that is missing.
    """
    if len(paths) == 1 and not _DIGITS.search(paths[0].stem):
        return (0,)
    numbers, first_prefix = [], None
    for path in paths:
        *prefix, number, rest = _DIGITS.split(path.stem) if _DIGITS.search(path.stem) else ("", "")
        if not prefix:
            raise ValueError(f"{path} has no frame number in its name: name frames like frame_0001{path.suffix}")
        series = "".join(prefix), rest
        first_prefix = first_prefix or series
        if series != first_prefix:
            raise ValueError(
                f"{path} and {paths[0]} belong to different series of frames: give each sequence its own subfolder"
            )
        numbers.append(int(number))
    for before, after, path in zip(numbers[:-1], numbers[1:], paths[1:], strict=True):
        if after == before:
            raise ValueError(f"{path} has the frame number {after} of another file: delete one of the two")
        if after != before + 1:
            raise ValueError(
                f"frame {before + 1} is missing before {path}: export it again, or renumber the files without a gap"
            )
    return tuple(numbers)


def inside(root: Path, folder: Path, name: str, named_by: Path) -> Path:
    """The file `name`, relative to `folder`, as long as it lies in `root` after links are followed.

    `named_by` is the file in which the name was found. Raises ValueError for a name that leads out of `root`: what a
    file says is data, and must not reach other files of the machine.
    """
    target = (folder / name.replace("\\", "/")).resolve()
    if ":" in name or "\0" in name or not target.is_relative_to(root.resolve()):
        raise ValueError(
            f"{named_by} names {name!r}, which is not a file inside {root}: copy the file there and name it relatively"
        )
    return target
