"""One texture for the whole mesh: an image given, named by the material or found; several are packed side by side."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from avatarjax.data.importers import series
from avatarjax.data.importers.raw import Material
from avatarjax.io import exr

FOLDER = "textures"
SUFFIXES = (".png", ".jpg", ".jpeg", ".tga", ".tif", ".tiff", ".bmp", ".exr")
_COLOR_WORDS = ("basecolor", "base_color", "albedo", "diffuse", "color")
# Texels of each image repeated around it, so that bilinear sampling at its border does not see its neighbour.
_MARGIN = 2


def read(path: str | os.PathLike) -> UInt8[np.ndarray, "h w 3"]:
    """An image as RGB, grey repeated and alpha dropped; ValueError that names a missing or unreadable file."""
    pixels = exr.read_png(path)
    return np.ascontiguousarray(pixels[..., :3] if pixels.shape[-1] >= 3 else np.repeat(pixels[..., :1], 3, axis=-1))


def decode(data: bytes, source: str) -> UInt8[np.ndarray, "h w 3"]:
    """An image that lies inside another file, PNG or JPEG; ValueError that names the source where it is damaged."""
    suffix = ".png" if data[:4] == b"\x89PNG" else ".jpg"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"image{suffix}"
        path.write_bytes(data)
        try:
            return read(path)
        except ValueError as error:
            raise ValueError(f"{source} is not a readable PNG or JPEG image: embed it again") from error


def find(folder: Path) -> Path | None:
    """The only image of `folder`/textures, or the only one there with a name such as albedo or base color.

    Raises ValueError where several remain.
    """
    images = [p for p in sorted((folder / FOLDER).glob("*")) if p.suffix.lower() in SUFFIXES]
    named = [p for p in images if any(word in p.stem.lower() for word in _COLOR_WORDS)]
    images = named if len(images) > 1 and named else images
    if len(images) > 1:
        listed = ", ".join(p.name for p in images)
        raise ValueError(f"{folder / FOLDER} holds several images ({listed}): pass textures=PATH_OF_THE_COLOUR_IMAGE")
    return images[0] if images else None


def named_image(root: Path, folder: Path, name: str, named_by: Path) -> Path:
    """The image that a material names, inside `root`: where it says, or of that name in `root` or its textures folder.

    Exporters often write absolute paths of the artist's machine, so the bare name is tried too. Raises ValueError
    where no such file is inside `root`.
    """
    bare = name.replace("\\", "/").rsplit("/", 1)[-1]
    for base in (folder, root, root / FOLDER):
        try:
            candidate = series.inside(root, base, bare, named_by)
        except ValueError:
            continue
        if candidate.is_file():
            return candidate
    target = series.inside(root, folder, name, named_by)
    if not target.is_file():
        raise ValueError(f"{named_by} names the texture {name!r}, which is missing: copy it to {root / FOLDER}")
    return target


def combine(
    materials: Sequence[Material],
    face_materials: Int[np.ndarray, " g"],
    uvs: Float[np.ndarray, "g 3 2"] | None,
) -> tuple[UInt8[np.ndarray, "h w 3"] | None, Float[np.ndarray, "g 3 2"] | None]:
    """One texture (h, w, 3), or None, and the texture coordinates (g, 3, 2) in it.

    One image used by every face stays as it is. Otherwise the materials in use, images and plain colours, are put side
    by side without resizing. Triangles in a repetition of the image are moved into the unit square.
    """
    used = [int(k) for k in np.unique(face_materials)]
    images = [materials[k].image for k in used]
    if uvs is None or all(image is None for image in images):
        return None, uvs
    if all(image is images[0] for image in images):
        return images[0], _unit_square(uvs)
    tiles = [
        np.full((8, 8, 3), materials[k].color, np.uint8) if image is None else image
        for k, image in zip(used, images, strict=True)
    ]
    height = max(len(tile) for tile in tiles) + 2 * _MARGIN
    width = sum(tile.shape[1] + 2 * _MARGIN for tile in tiles)
    packed, moved, left = np.zeros((height, width, 3), np.uint8), _unit_square(uvs).astype(np.float64), 0
    for k, tile in zip(used, tiles, strict=True):
        rows, columns = tile.shape[:2]
        around = np.pad(tile, ((_MARGIN, _MARGIN), (_MARGIN, _MARGIN), (0, 0)), mode="edge")
        packed[: rows + 2 * _MARGIN, left : left + columns + 2 * _MARGIN] = around
        own = face_materials == k
        local = np.clip(moved[own], 0, 1)
        x = left + _MARGIN + local[..., 0] * columns
        y = _MARGIN + (1 - local[..., 1]) * rows
        moved[own] = np.stack([x / width, 1 - y / height], axis=-1)
        left += columns + 2 * _MARGIN
    return packed, moved.astype(np.float32)


def _unit_square(uvs: np.ndarray) -> np.ndarray:
    """Triangles whose middle lies outside the unit square, moved into it by whole numbers; the others untouched."""
    middle = uvs.mean(axis=1, keepdims=True)
    return uvs - np.where((middle < 0) | (middle > 1), np.floor(middle), 0).astype(uvs.dtype)
