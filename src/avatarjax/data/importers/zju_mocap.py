"""ZJU-MoCap (Peng et al. 2021, "Neural Body"): one camera of a sequence, in the layout in which it is published.

annots.npy                              {"cams": {"K": [3x3], "D": [5x1], "R": [3x3], "T": [3x1, millimetres]},
                                         "ims": [{"ims": [a path for each camera]}, ... a frame]}
Camera_B1/000000.jpg ...                images, as annots.npy names them
mask_cihp/Camera_B1/000000.png ...      or mask/: parts of the body in the pixels' values, 0 is background
new_params/0.npy ...                    or params/: SMPL's poses, Rh and Th, as `smpl` reads them
new_vertices/0.npy ...                  not needed

Image k has the parameters k.npy; CoreView_313 and 315 name images Camera (1)/CoreView_313_Camera_(1)_0001_....jpg and
count from 1. The world is z-up in metres and becomes ours by (x, z, -y). Lenses are undistorted. Calibration counts
pixel centres from 0, so that principal points move by half a pixel. The files say no rate: frames count as 30 a second.
"""

from __future__ import annotations

import re
import typing
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from avatarjax.cameras import Camera
from avatarjax.data.importers import axes, series, smpl
from avatarjax.data.importers.distortion import Undistortion
from avatarjax.data.recording import MonocularVideo, not_rotations, read_nonzero, read_rgb, solid
from avatarjax.io import exr

ANNOTATIONS = "annots.npy"
MASKS = ("mask_cihp", "mask")
PARAMETERS = ("new_params", "params")
FPS = 30.0
_WORLD = axes.matrix("z")
_LONG_NAME = re.compile(r"CoreView_\d+_Camera_\(\d+\)_(\d+)_")


def recognises(folder: Path) -> bool:
    """Whether a folder is a sequence in this layout."""
    return (folder / ANNOTATIONS).is_file()


def load(folder: Path, camera: str | None) -> MonocularVideo:
    """What `camera`, the name of an image folder such as "Camera_B1", saw of the sequence; None takes the first.

    Raises ValueError that names the file and what was expected where something is missing or damaged.
    """
    path = folder / ANNOTATIONS
    annotations = smpl.read_parameters(path)
    try:
        rows = [[str(name) for name in entry["ims"]] for entry in annotations["ims"]]
        calibration = {name: annotations["cams"][name] for name in ("K", "D", "R", "T")}
    except (KeyError, TypeError, IndexError) as error:
        raise ValueError(
            f"{path} is damaged ({error!r}): needs cams with K, D, R and T, and ims with paths for each frame"
        ) from error
    if not rows or not rows[0] or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError(f"{path} names no images, or not one for each camera in every frame")
    column = _column(rows[0], camera, path)
    images = [series.inside(folder, folder, row[column], path) for row in rows]
    masks, parameters = _folder(folder, MASKS), _folder(folder, PARAMETERS)
    mask_paths = [series.inside(folder, masks, str(Path(row[column]).with_suffix(".png")), path) for row in rows]
    pose_paths = [parameters / f"{_number(image, path)}.npy" for image in images]
    for needed in (*images, *mask_paths, *pose_paths):
        if not needed.is_file():
            raise ValueError(f"{needed} does not exist, which {path} names: copy the whole sequence")

    height, width = exr.read_png(images[0]).shape[:2]
    view, lens = _camera(calibration, column, width, height, path)
    return MonocularVideo(
        folder,
        solid(np.stack([_read_mask(mask, view, lens) for mask in mask_paths])),
        view,
        smpl.read_poses(pose_paths, _WORLD),
        FPS,
        lambda: _decode(images, view, lens),
    )


def _column(names: list[str], camera: str | None, path: Path) -> int:
    """The place of a camera among the images of a frame."""
    cameras = [Path(name).parent.name for name in names]
    if camera is None:
        return 0
    if camera not in cameras:
        raise ValueError(f"{path} has no camera {camera!r}: choose one of {', '.join(cameras)}")
    return cameras.index(camera)


def _folder(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_dir():
            return folder / name
    raise ValueError(f"{folder} has neither {' nor '.join(names)}: copy the whole sequence")


def _number(image: Path, path: Path) -> int:
    """The number of an image's parameters."""
    match = _LONG_NAME.match(image.name)
    digits = match[1] if match else image.stem
    if not digits.isdecimal():
        raise ValueError(f"{path} names {image.name}: expected 000000.jpg, or CoreView_313_Camera_(1)_0001_....jpg")
    return int(digits)


def _camera(
    calibration: dict[str, typing.Any], column: int, width: int, height: int, path: Path
) -> tuple[Camera, Undistortion | None]:
    """The camera in our world, and how to undistort what it saw, None for a pinhole camera."""
    try:
        sizes = {"K": (3, 3), "D": (-1,), "R": (3, 3), "T": (3,)}
        k, d, r, t = (np.asarray(calibration[n][column], np.float64).reshape(shape) for n, shape in sizes.items())
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise ValueError(f"{path}: camera {column} is damaged ({error}): needs K 3x3, D 5x1, R 3x3, T 3x1") from error
    if not (np.isfinite(k).all() and np.isfinite(t).all()) or k[0, 0] <= 0 or k[1, 1] <= 0 or not_rotations(r):
        raise ValueError(f"{path}: camera {column} is not finite, has no focal length, or its R is no rotation")
    try:
        lens = Undistortion(k, d, width, height) if d.any() else None
    except ValueError as error:
        raise ValueError(f"{path}: camera {column}: {error}") from error
    return _ours(r, t / 1000, k, width, height), lens


def _ours(
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, "3"],
    intrinsics: Float[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> Camera:
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation @ _WORLD.T, translation
    centred = intrinsics.copy()
    centred[:2, 2] += 0.5
    return Camera(jnp.asarray(world_to_camera, jnp.float32), jnp.asarray(centred, jnp.float32), width, height)


def _read_mask(path: Path, view: Camera, lens: Undistortion | None) -> np.ndarray:
    mask = read_nonzero(path, view)
    return lens.mask(mask) if lens else mask


def _decode(images: list[Path], view: Camera, lens: Undistortion | None) -> Iterator[np.ndarray]:
    for pixels in read_rgb(images, view):
        yield lens.image(pixels) if lens else pixels
