"""Pinhole cameras in the OpenCV convention: x right, y down, z forward, pixel centres at +0.5."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


@typing.no_type_check
@flax.struct.dataclass
class Camera:
    """A pinhole camera: world_to_camera (4, 4), intrinsics (3, 3) in pixels, image size as static integers.

    Leading batch axes on the two matrices make it a batch of cameras of one size, for use under `jax.vmap`.
    """

    world_to_camera: Float[Array, "*b 4 4"]
    intrinsics: Float[Array, "*b 3 3"]
    width: int = flax.struct.field(pytree_node=False)
    height: int = flax.struct.field(pytree_node=False)

    @property
    def position(self) -> Float[Array, "*b 3"]:
        """Centre of projection in the world, metres."""
        r, t = self.world_to_camera[..., :3, :3], self.world_to_camera[..., :3, 3]
        return -jnp.einsum("...ji,...j->...i", r, t)


def look_at(
    eye: typing.Any,
    target: typing.Any,
    *,
    width: int,
    height: int,
    fov_y: float = 0.7,
    up: typing.Any = (0.0, 1.0, 0.0),
) -> Camera:
    """A camera at `eye` (3,) that looks at `target` (3,), both in metres; `fov_y` is the vertical angle, radians.

    Raises ValueError where the eye lies on the target or the view direction is parallel to `up`.
    """
    if width < 1 or height < 1:
        raise ValueError(f"image size must be positive, got {width}x{height}")
    eye, target, up = (np.asarray(x, np.float64) for x in (eye, target, up))
    forward = target - eye
    right = np.cross(forward, up)
    if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9:
        raise ValueError(f"no view direction from eye {eye} to target {target} with up {up}: move the eye")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    focal = 0.5 * height / np.tan(fov_y / 2)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(jnp.asarray(pose, jnp.float32), jnp.asarray(intrinsics, jnp.float32), width, height)


def orbit(
    azimuths: typing.Any,
    *,
    target: typing.Any,
    distance: float,
    width: int,
    height: int,
    heights: typing.Any = 0.0,
    fov_y: float = 0.7,
) -> Camera:
    """A batch of cameras on a cylinder about the vertical axis through `target`, all looking at `target`.

    `azimuths` (k,) radians: 0 sees the front of a figure that faces +z, pi/2 sees it from +x. `heights` (k,) or a
    scalar, metres above the target. UNICA trains its appearance on 50 views of this kind (B.1).
    """
    azimuths = np.atleast_1d(np.asarray(azimuths, np.float64))
    heights = np.broadcast_to(np.asarray(heights, np.float64), azimuths.shape)
    target = np.asarray(target, np.float64)
    offsets = np.stack([distance * np.sin(azimuths), heights, distance * np.cos(azimuths)], axis=-1)
    each = [look_at(target + o, target, width=width, height=height, fov_y=fov_y) for o in offsets]
    return Camera(jnp.stack([c.world_to_camera for c in each]), jnp.stack([c.intrinsics for c in each]), width, height)


def project(camera: Camera, points: Float[Array, "n 3"]) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Pixel coordinates (n, 2) and depth along the optical axis (n,) in metres of world points (n, 3)."""
    p = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[None, :3, 3]
    uvw = p @ camera.intrinsics.T
    return uvw[:, :2] / uvw[:, 2:], p[:, 2]
