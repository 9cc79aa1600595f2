"""What a result was made on: versions, device, cores, date and commit; nothing that names a machine or its paths."""

from __future__ import annotations

import datetime
import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path

import jax


def describe() -> dict[str, str]:
    """Name and value of each thing that a number may depend on, in the order to show them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    devices = jax.devices()
    return {
        "avatarjax": _version("avatarjax"),
        "commit": _commit(Path(__file__).parent) or "not a git clone",
        "Python": platform.python_version(),
        "jax, jaxlib": f"{jax.__version__}, {_version('jaxlib')}",
        "backend": jax.default_backend(),
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "processor": f"{platform.machine()}, {cores} cores",
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed as a package"


def _commit(folder: Path) -> str | None:
    """The commit that `folder` is at, and whether files differ from it; None outside a clone or without git.

    A package installed into somebody's own repository is not part of it: the file must be tracked.
    """

    def git(*words: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, check=True, timeout=20
        )
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short=12", "HEAD") + (", with changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return None
