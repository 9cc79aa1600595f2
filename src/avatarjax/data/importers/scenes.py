"""3D Gaussian scenes in the layout of the original implementation (INRIA, Kerbl et al. 2023)."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import typing
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.io import ply


@dataclasses.dataclass(frozen=True, eq=False)
class GaussianScene:
    """A cloud of Gaussians and the cameras it was trained with, both in the file's own world.

    cameras may differ in size, so they are a tuple; camera_names are the images' names; iteration is None for a file.
    """

    gaussians: Gaussians
    cameras: tuple[Camera, ...]
    camera_names: tuple[str, ...]
    iteration: int | None
    source: str


def load_gaussian_scene(path: str | os.PathLike, *, iteration: int | None = None) -> GaussianScene:
    """Load a .ply cloud, or a trained folder: point_cloud/iteration_*/point_cloud.ply and, if there, cameras.json.

    The newest iteration by default. Raises ValueError that names the file which is missing or damaged, or lists the
    iterations there are.
    """
    path = Path(path)
    if path.is_file():
        return GaussianScene(_finite(path), (), (), None, str(path))
    found = {
        int(match[1]): folder / "point_cloud.ply"
        for folder in (path / "point_cloud").glob("iteration_*")
        if (match := re.fullmatch(r"iteration_(\d+)", folder.name)) and (folder / "point_cloud.ply").is_file()
    }
    if not found:
        raise ValueError(
            f"{path} is no Gaussian scene: expected point_cloud/iteration_*/point_cloud.ply, or a .ply file"
        )
    chosen = max(found) if iteration is None else iteration
    if chosen not in found:
        raise ValueError(f"{path} has no iteration {chosen}: choose one of {', '.join(map(str, sorted(found)))}")
    names, cameras = read_cameras(path / "cameras.json") if (path / "cameras.json").is_file() else ((), ())
    return GaussianScene(_finite(found[chosen]), cameras, names, chosen, str(found[chosen]))


def read_cameras(path: str | os.PathLike) -> tuple[tuple[str, ...], tuple[Camera, ...]]:
    """Names and cameras of a cameras.json: a list of img_name, width, height, fx, fy, position and rotation.

    `rotation` (3, 3) turns camera axes (OpenCV) to the world, `position` (3,) is the camera's centre; the principal
    point is the middle of the image. Raises ValueError that names the file and the camera which is not like that.
    """
    path = Path(path)
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} cannot be read as JSON ({error})") from error
    if not isinstance(entries, list):
        raise ValueError(f"{path} must hold a list of cameras, as the original implementation writes it")
    names, cameras = [], []
    for k, entry in enumerate(entries):
        try:
            names.append(str(entry.get("img_name", k)))
            cameras.append(_camera(entry))
        except (KeyError, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{path}, camera {k} is damaged ({error!r}): write cameras.json again") from error
    return tuple(names), tuple(cameras)


def _camera(entry: dict[str, typing.Any]) -> Camera:
    rotation, position = np.array(entry["rotation"], np.float64), np.array(entry["position"], np.float64)
    width, height = int(entry["width"]), int(entry["height"])
    if rotation.shape != (3, 3) or position.shape != (3,) or not np.isfinite(rotation).all():
        raise ValueError(f"rotation of shape {rotation.shape} and position of shape {position.shape}")
    if not np.isfinite(position).all() or abs(np.linalg.det(rotation) - 1) > 1e-3 or width < 1 or height < 1:
        raise ValueError("rotation must be a rotation, position finite, width and height positive")
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation.T, -rotation.T @ position
    intrinsics = [[float(entry["fx"]), 0, width / 2], [0, float(entry["fy"]), height / 2], [0, 0, 1]]
    return Camera(
        jnp.asarray(world_to_camera, jnp.float32), jnp.asarray(np.array(intrinsics), jnp.float32), width, height
    )


def _finite(path: Path) -> Gaussians:
    gaussians = ply.read_ply(path)
    for name in ("means", "log_scales", "quats", "logit_opacities", "colors"):
        if not np.isfinite(np.asarray(getattr(gaussians, name))).all():
            raise ValueError(f"{path}: {name} of a Gaussian is not finite: train or prune the scene again")
    return gaussians
