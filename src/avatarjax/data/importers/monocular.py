"""A monocular video of a person with masks, cameras and poses, as SMAD takes it: one folder, read and written.

video.mp4 or images/0000.png ...   RGB frames
masks/0000.png ...                 foreground above 127
cameras.json                       {"convention": "opencv", "width": w, "height": h,
                                    "cameras": [{"intrinsics": 3x3, "world_to_camera": 4x4}, ...]}: one, or one a frame
poses.npz                          rotations (f, j, 3, 3), root_rotation (f, 3, 3), root_translation (f, 3);
                                   optional names (j,), parents (j,) and joints (j, 3) of the rest pose
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import tempfile
import typing
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, UInt8

from avatarjax.cameras import Camera
from avatarjax.data.importers import dress4d, series, zju_mocap
from avatarjax.data.recording import MonocularVideo, Poses, check_poses, not_rotations, solid
from avatarjax.io import atomic, exr, video

VIDEO, IMAGES, MASKS, CAMERAS, POSES = "video.mp4", "images", "masks", "cameras.json", "poses.npz"


def load_monocular(folder: str | os.PathLike, *, camera: str | None = None, lazy: bool = True) -> MonocularVideo:
    """Load a monocular folder; with `lazy` RGB frames stay in their files until they are asked for.

    A sequence of ZJU-MoCap or a take of 4D-DRESS, in the layout in which each is published, is recognised: `camera`
    then names the one to look through, by default the first. Raises ValueError that names the file for whatever is
    missing or damaged, for sizes that differ, and where frames, masks, cameras and poses do not count the same.
    """
    folder = Path(folder)
    if zju_mocap.recognises(folder):
        loaded = zju_mocap.load(folder, camera)
    elif dress4d.recognises(folder):
        loaded = dress4d.load(folder, camera)
    elif camera is not None:
        raise ValueError(f"{folder} is filmed by one camera: camera={camera!r} is for ZJU-MoCap and 4D-DRESS only")
    else:
        loaded = _load(folder)
    return loaded if lazy else loaded.held()


def _load(folder: Path) -> MonocularVideo:
    for name in (CAMERAS, POSES, MASKS):
        if not (folder / name).exists():
            raise ValueError(f"{folder} has no {name}: a monocular folder needs video.mp4 or images, masks, "
                             "cameras.json and poses.npz")  # fmt: skip
    camera = _read_cameras(folder / CAMERAS)
    poses = _read_poses(folder / POSES)
    mattes = np.stack([_read_matte(path, camera) for path in _pictures(folder / MASKS)])
    count, fps = _count(folder)
    lengths = {"masks": len(mattes), "poses": len(poses)}
    if camera.world_to_camera.ndim == 3:
        lengths["cameras"] = len(camera.world_to_camera)
    for what, length in lengths.items():
        if length != count:
            raise ValueError(f"{folder} has {count} frames and {length} {what}: give one for each frame")
    return MonocularVideo(folder, mattes, camera, poses, fps, functools.partial(_decode, folder, camera))


def write_monocular(
    folder: str | os.PathLike,
    frames: Iterable[UInt8[np.ndarray, "h w 3"]],
    masks: Iterable[Bool[np.ndarray, "h w"] | UInt8[np.ndarray, "h w"]],
    camera: Camera,
    poses: Poses,
    *,
    as_video: bool = False,
    fps: int = 30,
) -> None:
    """Write a monocular folder, which appears whole or not at all; PNG frames without loss, or an H.264 video.

    Masks are boolean, or mattes as `MonocularVideo` has them.
    Raises ValueError where the folder exists and is not empty, or the data do not count the same.
    """
    folder = Path(folder)
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(f"{folder} exists and is not empty: choose another folder, or delete it")
    if as_video and (camera.width % 2 or camera.height % 2):
        raise ValueError(f"a video needs even sides, got {camera.width}x{camera.height}: write images instead")
    check_poses(poses, folder / POSES)
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        if as_video:
            video.write_video(temporary / VIDEO, frames, fps=fps)
        else:
            for k, frame in enumerate(frames):
                exr.write_png(temporary / IMAGES / f"{k:05d}.png", frame)
        for k, mask in enumerate(masks):
            matte = mask if mask.dtype == np.uint8 else solid(mask)
            exr.write_png(temporary / MASKS / f"{k:05d}.png", matte[..., None])
        _write_cameras(temporary / CAMERAS, camera, fps)
        arrays: dict[str, np.ndarray] = {
            "rotations": poses.rotations,
            "root_rotation": poses.root_rotation,
            "root_translation": poses.root_translation,
        }
        if poses.names is not None:
            arrays["names"] = np.array(poses.names)
        if poses.parents is not None:
            arrays["parents"] = np.array(poses.parents, np.int32)
        if poses.joints is not None:
            arrays["joints"] = poses.joints
        np.savez(temporary / POSES, allow_pickle=False, **arrays)
        # What was written is read again: it must be a whole folder before it gets its name.
        for _ in load_monocular(temporary).frames():
            pass
        temporary.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _pictures(folder: Path) -> list[Path]:
    paths = series.natural_order(folder.glob("*.png"))
    if not paths:
        raise ValueError(f"{folder} holds no .png files")
    series.frame_numbers(paths)
    return paths


def _count(folder: Path) -> tuple[int, float]:
    """Number of RGB frames and frames a second."""
    path = folder / VIDEO
    if path.is_file() and (folder / IMAGES).is_dir():
        raise ValueError(f"{folder} has both {VIDEO} and {IMAGES}: keep one")
    if (folder / IMAGES).is_dir():
        return len(_pictures(folder / IMAGES)), _stated_fps(folder / CAMERAS)
    if not path.is_file():
        raise ValueError(f"{folder} has neither {VIDEO} nor {IMAGES}")
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            count = sum(packet.pts is not None for packet in container.demux(stream))
            return count, float(stream.average_rate or 30)
    except (av.FFmpegError, IndexError) as error:
        raise ValueError(f"{path} cannot be read as a video ({error}): encode it again") from error


def _decode(folder: Path, camera: Camera) -> Iterator[np.ndarray]:
    expected = (camera.height, camera.width)
    if (folder / IMAGES).is_dir():
        for path in _pictures(folder / IMAGES):
            pixels = exr.read_png(path)
            if pixels.shape[:2] != expected or pixels.shape[2] < 3:
                raise ValueError(f"{path} has shape {pixels.shape}, {CAMERAS} says {expected} RGB")
            yield np.ascontiguousarray(pixels[..., :3])
        return
    import av

    with av.open(str(folder / VIDEO)) as container:
        for frame in container.decode(video=0):
            pixels = frame.to_ndarray(format="rgb24")
            if pixels.shape[:2] != expected:
                raise ValueError(f"{folder / VIDEO} has frames of {pixels.shape[:2]}, {CAMERAS} says {expected}")
            yield pixels


def _read_matte(path: Path, camera: Camera) -> np.ndarray:
    pixels = exr.read_png(path)
    if pixels.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"{path} has shape {pixels.shape[:2]}, {CAMERAS} says {(camera.height, camera.width)}")
    return pixels[..., 0]


def _json(path: Path) -> dict[str, typing.Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} cannot be read as JSON ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold an object with width, height and cameras")
    return content


def _stated_fps(path: Path) -> float:
    return float(_json(path).get("fps", 30.0))


def _read_cameras(path: Path) -> Camera:
    content = _json(path)
    if content.get("convention", "opencv") != "opencv":
        raise ValueError(
            f"{path}: convention {content['convention']!r} is unknown: write opencv cameras (y down, z forward)"
        )
    try:
        views = np.array([entry["world_to_camera"] for entry in content["cameras"]], np.float64)
        intrinsics = np.array([entry["intrinsics"] for entry in content["cameras"]], np.float64)
        width, height = int(content["width"]), int(content["height"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged ({error!r}): needs width, height and cameras") from error
    if views.ndim != 3 or views.shape[1:] != (4, 4) or intrinsics.shape != (len(views), 3, 3):
        raise ValueError(
            f"{path}: world_to_camera must be 4x4 and intrinsics 3x3, got {views.shape}, {intrinsics.shape}"
        )
    rotations = views[:, :3, :3]
    if not (np.isfinite(views).all() and np.isfinite(intrinsics).all()) or not_rotations(rotations):
        raise ValueError(f"{path}: a camera is not finite, or its rotation is none (no scale, no reflection)")
    pair = jnp.asarray(views, jnp.float32), jnp.asarray(intrinsics, jnp.float32)
    return Camera(*(pair if len(views) > 1 else (pair[0][0], pair[1][0])), width, height)


def _write_cameras(path: Path, camera: Camera, fps: int) -> None:
    views = np.asarray(camera.world_to_camera, np.float64).reshape(-1, 4, 4)
    intrinsics = np.broadcast_to(np.asarray(camera.intrinsics, np.float64), (*camera.world_to_camera.shape[:-2], 3, 3))
    entries = [
        {"intrinsics": k.tolist(), "world_to_camera": w.tolist()}
        for k, w in zip(intrinsics.reshape(-1, 3, 3), views, strict=True)
    ]
    content = {"convention": "opencv", "width": camera.width, "height": camera.height, "fps": fps, "cameras": entries}
    atomic.write_text(path, json.dumps(content, indent=1))


def _read_poses(path: Path) -> Poses:
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, OSError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} is not a whole NPZ file of plain arrays ({error}): write it with numpy.savez"
        ) from error
    needed = ("rotations", "root_rotation", "root_translation")
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise ValueError(f"{path} has no {', '.join(missing)}, only {', '.join(arrays)}")
    poses = Poses(
        *(arrays[name].astype(np.float32) for name in needed),
        names=tuple(str(name) for name in arrays["names"]) if "names" in arrays else None,
        parents=tuple(int(parent) for parent in arrays["parents"]) if "parents" in arrays else None,
        joints=arrays["joints"].astype(np.float32) if "joints" in arrays else None,
    )
    check_poses(poses, path)
    return poses
