"""What a single camera sees of a person: frames, masks, cameras and poses, wherever they were read from."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from avatarjax.cameras import Camera
from avatarjax.io import exr


@typing.no_type_check
@dataclasses.dataclass(frozen=True, eq=False)
class Poses:
    """Poses over f frames in our axes and metres: rotations (f, j, 3, 3) of joints relative to their parents,
    root_rotation (f, 3, 3) and root_translation (f, 3) to the world; names (j,) and parents (j,), -1 for a root, or
    None; joints (j, 3): where they are in the rest pose, in which all rotations are the identity, or None.
    """

    rotations: Float[np.ndarray, "f j 3 3"]
    root_rotation: Float[np.ndarray, "f 3 3"]
    root_translation: Float[np.ndarray, "f 3"]
    names: tuple[str, ...] | None = None
    parents: tuple[int, ...] | None = None
    joints: Float[np.ndarray, "j 3"] | None = None

    def __len__(self) -> int:
        return len(self.rotations)


@dataclasses.dataclass(frozen=True, eq=False)
class MonocularVideo:
    """f frames of one person: mattes (f, h, w), a camera (one, or a batch of f), poses, and RGB frames.

    Mattes say how much of each pixel the person covers, 0 to 255, where the frames show the person's own colour. Where
    no more than masks is known they are all or nothing (`solid`), and a pixel at an edge is mixed with what is behind.

    Iterate over `frames()` to decode one (h, w, 3) uint8 image at a time; `images()` holds all of them. `decode()`
    begins to read them from their files.
    """

    folder: Path
    mattes: UInt8[np.ndarray, "f h w"]
    camera: Camera
    poses: Poses
    fps: float
    decode: Callable[[], Iterator[np.ndarray]]
    _loaded: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.mattes)

    @functools.cached_property
    def masks(self) -> Bool[np.ndarray, "f h w"]:
        """Pixels of which the person covers half or more."""
        return self.mattes > 127

    def frames(self) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """The RGB frames in order, decoded as they are asked for."""
        return iter(self._loaded) if self._loaded is not None else self.decode()

    def images(self) -> UInt8[np.ndarray, "f h w 3"]:
        """All RGB frames at once."""
        return self._loaded if self._loaded is not None else np.stack(list(self.frames()))

    def camera_at(self, frame: int) -> Camera:
        """The camera of one frame."""
        if self.camera.world_to_camera.ndim == 2:
            return self.camera
        return self.camera.replace(
            world_to_camera=self.camera.world_to_camera[frame], intrinsics=self.camera.intrinsics[frame]
        )

    def only(self, frames: Int[np.ndarray, " k"]) -> MonocularVideo:
        """The video of some frames (k,), counted from 0, in this order and in memory; `fps` stays what it was."""
        camera, poses = self.camera, self.poses
        if camera.world_to_camera.ndim == 3:
            camera = camera.replace(
                world_to_camera=camera.world_to_camera[frames], intrinsics=camera.intrinsics[frames]
            )
        parts = {name: getattr(poses, name)[frames] for name in ("rotations", "root_rotation", "root_translation")}
        chosen = {"mattes": self.mattes[frames], "camera": camera, "poses": dataclasses.replace(poses, **parts)}
        return dataclasses.replace(self, **chosen, _loaded=self.images()[frames])

    def held(self) -> MonocularVideo:
        """The same video with all of its frames in memory."""
        return dataclasses.replace(self, _loaded=self.images())


def solid(masks: Bool[np.ndarray, "*f h w"]) -> UInt8[np.ndarray, "*f h w"]:
    """Mattes that are all or nothing."""
    return np.where(masks, np.uint8(255), np.uint8(0))


def check_poses(poses: Poses, path: Path) -> None:
    """ValueError that names `path`, their file, where the parts of poses do not fit each other or are no rotations."""
    shape = poses.rotations.shape
    if poses.rotations.ndim != 4 or shape[2:] != (3, 3):
        raise ValueError(f"{path}: rotations must be of shape (f, j, 3, 3), got {shape}")
    if poses.root_rotation.shape != (shape[0], 3, 3) or poses.root_translation.shape != (shape[0], 3):
        found = poses.root_rotation.shape, poses.root_translation.shape
        raise ValueError(f"{path}: root_rotation and root_translation of shapes {found} do not fit {shape[0]} frames")
    for name, values in (("rotations", poses.rotations), ("root_rotation", poses.root_rotation)):
        if not_rotations(values):
            raise ValueError(f"{path}: {name} holds a matrix that is no rotation: orthonormalise it")
    if not np.isfinite(poses.root_translation).all():
        raise ValueError(f"{path}: root_translation is not finite")
    for name, values in (("names", poses.names), ("parents", poses.parents)):
        if values is not None and len(values) != shape[1]:
            raise ValueError(f"{path}: {len(values)} {name} for {shape[1]} joints")
    if poses.joints is not None and (poses.joints.shape != (shape[1], 3) or not np.isfinite(poses.joints).all()):
        raise ValueError(f"{path}: joints {poses.joints.shape} must be {shape[1]} finite points (x, y, z) in metres")


def not_rotations(matrices: Float[np.ndarray, "*b 3 3"]) -> bool:
    """Whether any matrix is not finite, or no rotation to one per cent."""
    if not np.isfinite(matrices).all():
        return True
    products = np.swapaxes(matrices, -1, -2) @ matrices
    return bool((np.abs(products - np.eye(3)) > 1e-2).any() or (np.linalg.det(matrices) < 0).any())


def read_sized(path: Path, camera: Camera) -> UInt8[np.ndarray, "h w c"]:
    """The pixels of a picture that this camera took; ValueError that names a file of another size."""
    pixels = exr.read_png(path)
    if pixels.shape[:2] != (camera.height, camera.width):
        raise ValueError(f"{path} has shape {pixels.shape[:2]}, the first image {(camera.height, camera.width)}")
    return pixels


def read_nonzero(path: Path, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """A mask in which this camera's foreground is all that is not black."""
    pixels = read_sized(path, camera)
    # An alpha channel, the second or the fourth, is opaque everywhere.
    return (pixels[..., : 1 if pixels.shape[2] < 3 else 3] != 0).any(-1)


def read_rgb(paths: Iterable[Path], camera: Camera) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """The RGB pictures that this camera took, read as they are asked for; ValueError that names what is none."""
    for path in paths:
        pixels = read_sized(path, camera)
        if pixels.shape[2] < 3:
            raise ValueError(f"{path} has {pixels.shape[2]} channels, expected RGB")
        yield np.ascontiguousarray(pixels[..., :3])
