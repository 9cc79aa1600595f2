"""4D-DRESS (Wang et al. 2024): one camera of a take, in the layout in which it is published.

Capture/cameras.pkl                                {"0004": {"intrinsics": 3x3, "extrinsics": 3x4 world to camera}, ...}
Capture/0004/images/capture-f00011.png ...         RGB
Capture/0004/masks/mask-f00011.png ...             0 is background
SMPL/mesh-f00011_smpl.pkl ...                      global_orient, body_pose and transl, as `smpl` reads them
Meshes_pkl, SMPLX, Semantic, basic_info.pkl        not needed

The folder is that of a take, such as 00148/Inner/Take7. World axes are ours already: y up, metres, the cameras are
OpenCV's without distortion, and 30 frames a second were captured.
"""

from __future__ import annotations

import functools
import re
import typing
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from avatarjax.cameras import Camera
from avatarjax.data.importers import series, smpl
from avatarjax.data.recording import MonocularVideo, not_rotations, read_nonzero, read_rgb, solid
from avatarjax.io import exr

CAPTURE, CAMERAS, SMPL = "Capture", "cameras.pkl", "SMPL"
FPS = 30.0
_IMAGE = re.compile(r"capture-f(\d+)\.png")


def recognises(folder: Path) -> bool:
    """Whether a folder is a take in this layout."""
    return (folder / CAPTURE).is_dir()


def load(folder: Path, camera: str | None) -> MonocularVideo:
    """What `camera`, such as "0004", saw of the take; None takes the first.

    Raises ValueError that names the file and what was expected where something is missing or damaged, or a frame is
    missing between others.
    """
    path = folder / CAPTURE / CAMERAS
    calibration = smpl.read_parameters(path)
    if not calibration:
        raise ValueError(f"{path} holds no cameras")
    camera = sorted(calibration)[0] if camera is None else camera
    if camera not in calibration:
        raise ValueError(f"{path} has no camera {camera!r}: choose one of {', '.join(sorted(calibration))}")
    seen = series.inside(folder, folder / CAPTURE, camera, path)
    images = [p for p in series.natural_order((seen / "images").glob("*.png")) if _IMAGE.fullmatch(p.name)]
    if not images:
        raise ValueError(f"{seen / 'images'} holds no capture-f*.png: copy the whole take")
    series.frame_numbers(images)
    frames = [match[1] for image in images if (match := _IMAGE.fullmatch(image.name))]
    masks = [seen / "masks" / f"mask-f{frame}.png" for frame in frames]
    parameters = [folder / SMPL / f"mesh-f{frame}_smpl.pkl" for frame in frames]
    for needed, image in zip((*masks, *parameters), 2 * images, strict=True):
        if not needed.is_file():
            raise ValueError(f"{needed} does not exist, but {image} does: copy the whole take")
    view = _camera(calibration[camera], *exr.read_png(images[0]).shape[1::-1], f"{path}, camera {camera}")
    return MonocularVideo(
        folder,
        solid(np.stack([read_nonzero(mask, view) for mask in masks])),
        view,
        smpl.read_poses(parameters, np.eye(3)),
        FPS,
        functools.partial(read_rgb, images, view),
    )


def _camera(entry: typing.Any, width: int, height: int, source: str) -> Camera:
    expected = "intrinsics 3x3 and extrinsics 3x4"
    try:
        intrinsics, extrinsics = (np.array(entry[name], np.float64) for name in ("intrinsics", "extrinsics"))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{source} is damaged ({error!r}): needs {expected}") from error
    if intrinsics.shape != (3, 3) or extrinsics.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{source} has shapes {intrinsics.shape}, {extrinsics.shape}: needs {expected}")
    world_to_camera = np.concatenate([extrinsics[:3], [[0, 0, 0, 1]]])
    if not (np.isfinite(world_to_camera).all() and np.isfinite(intrinsics).all()) or not_rotations(extrinsics[:3, :3]):
        raise ValueError(f"{source} is not finite, or its rotation is none")
    return Camera(jnp.asarray(world_to_camera, jnp.float32), jnp.asarray(intrinsics, jnp.float32), width, height)
