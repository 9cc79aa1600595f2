"""Folders that are whole or known not to be: a manifest, written last, lists every file's size and SHA-256."""

from __future__ import annotations

import hashlib
import json
import typing
from collections.abc import Iterable
from pathlib import Path

from avatarjax.io import atomic

NAME = "manifest.json"


def write(folder: Path, version: int, files: Iterable[str], **content: typing.Any) -> None:
    """Finish a folder: list its `files` (paths relative to it, with /) and whatever else describes it."""
    listed = {name: {"bytes": (folder / name).stat().st_size, "sha256": _digest(folder / name)} for name in files}
    atomic.write_text(folder / NAME, json.dumps({"version": version, **content, "files": listed}, indent=1))


def read(folder: Path, version: int, needed: Iterable[str], again: str) -> dict[str, typing.Any]:
    """The manifest of a finished folder; `again` tells what to do when there is none.

    Raises ValueError for a folder without one, another version, a manifest that is damaged, lists none of the `needed`
    files, or names a file outside the folder.
    """
    path = folder / NAME
    if not path.is_file():
        raise ValueError(f"{folder} has no finished dataset (no {NAME}): {again}")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        listed = {name: (file["bytes"], file["sha256"]) for name, file in manifest["files"].items()}
        found = manifest["version"]
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise ValueError(f"{path} is damaged ({error!r}): {again}") from error
    for name in listed:
        # A manifest is data: it may name files of its own folder only.
        if Path(name).is_absolute() or ".." in Path(name).parts or "\\" in name or ":" in name:
            raise ValueError(f"{path} names {name!r}, which is not a file of this dataset: {again}")
    if found != version:
        raise ValueError(f"{folder} has data of version {found}, this is version {version}: {again}")
    missing = sorted(set(needed) - set(listed))
    if missing:
        raise ValueError(f"{path} is damaged (it does not list {', '.join(missing)}): {again}")
    return manifest


def check(folder: Path, manifest: dict[str, typing.Any], again: str, names: Iterable[str] | None = None) -> None:
    """Compare files (all, or those named) with the manifest; ValueError names the first that is missing or damaged."""
    for name in manifest["files"] if names is None else names:
        path, expected = folder / name, manifest["files"][name]
        if not path.is_file():
            raise ValueError(f"{path} is missing: {again}")
        if path.stat().st_size != expected["bytes"] or _digest(path) != expected["sha256"]:
            raise ValueError(f"{path} is damaged (its checksum is not the manifest's): {again}")


def fingerprint(manifest: dict[str, typing.Any]) -> str:
    """A short name of the content, by which checkpoints know what they were trained on."""
    return hashlib.sha256(json.dumps(manifest["files"], sort_keys=True).encode()).hexdigest()[:12]


def _digest(path: Path) -> str:
    with path.open("rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()
