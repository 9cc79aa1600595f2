"""The avatars by name: a shaped, dressed and painted mesh on a rig, and its poses."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from avatarjax.data import cowgirl, draping, skinning
from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import Look

_LOOKS: dict[str, Callable[[], Look]] = {"cowgirl": cowgirl.look}
# Frames posed by one call of the compiled function: bounds its memory.
_CHUNK = 128


@dataclasses.dataclass(frozen=True, eq=False)
class AvatarMesh:
    """A dressed figure in its rest pose as NumPy arrays, metres; vertices and faces are the same in every frame.

    vertices (v, 3); faces (f, 3); uvs (f, 3, 2) of each triangle's corners, v up; texture (h, w, 3) sRGB; parts (f,)
    index into part_names; weights (v, j), rows sum to 1; lag (v,): how much of a vertex follows lagged bones; rig;
    basis: the same as constants for posing.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "f 3 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    parts: Int[np.ndarray, " f"]
    part_names: tuple[str, ...]
    weights: Float[np.ndarray, "v j"]
    lag: Float[np.ndarray, " v"]
    rig: Rig
    basis: draping.PosingBasis


def names() -> tuple[str, ...]:
    """The avatars that `build` knows."""
    return tuple(_LOOKS)


@functools.cache
def build(name: str) -> AvatarMesh:
    """The avatar of that name, the same arrays every time: treat them as read-only. Raises ValueError for other
    names."""
    if name not in _LOOKS:
        raise ValueError(f"unknown avatar {name!r}; there are {', '.join(names())}")
    look = _LOOKS[name]()
    basis = draping.posing_basis(look.vertices, look.weights, look.lag, look.drape)
    return AvatarMesh(
        name=name,
        vertices=look.vertices,
        faces=look.faces,
        uvs=look.uvs,
        texture=look.texture,
        parts=look.parts,
        part_names=look.part_names,
        weights=look.weights,
        lag=look.lag,
        rig=look.rig,
        basis=basis,
    )


def pose_vertices(
    avatar: AvatarMesh, transforms: Float[Array | np.ndarray, "f j 3 4"], lagged: Float[Array | np.ndarray, "f j 3 4"]
) -> Float[np.ndarray, "f v 3"]:
    """Posed vertices (f, v, 3) for the transforms and lagged transforms of a `Motion`, in the world, metres."""
    count = len(transforms)
    frames = np.empty((count, len(avatar.vertices), 3), np.float32)
    for start in range(0, count, _CHUNK):
        # The last chunk is filled up with its last frame, so that one compiled shape serves every length.
        picked = np.minimum(np.arange(start, start + min(_CHUNK, _rounded(count))), count - 1)
        posed = draping.pose_frames(avatar.basis, jnp.asarray(transforms)[picked], jnp.asarray(lagged)[picked])
        end = min(start + _CHUNK, count)
        frames[start:end] = np.asarray(posed)[: end - start]
    return frames


def _rounded(count: int) -> int:
    return 1 << (count - 1).bit_length()


def _pose_once(avatar: AvatarMesh, quats: np.ndarray) -> np.ndarray:
    hips = avatar.rig.heads[avatar.rig.index("Hips")]
    transforms = jax.jit(skinning.forward_kinematics)(avatar.rig, jnp.asarray(quats), jnp.asarray(hips))[None]
    vertices = pose_vertices(avatar, transforms, transforms)[0]
    return vertices - np.array([0, vertices[:, 1].min(), 0], np.float32)


def a_pose(avatar: AvatarMesh, degrees: float = 18.0) -> Float[np.ndarray, "v 3"]:
    """The reference pose (v, 3) of the position maps: standing, arms straight and lowered to `degrees` from the
    vertical, so that the figure is about twice as tall as it is wide."""
    rig = avatar.rig
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(rig.names), 1))
    angle = np.deg2rad(degrees)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = rig.index(side + "Arm")
        along = rig.tails[arm] - rig.heads[arm]
        along = along / np.linalg.norm(along)
        wanted = np.array([sign * np.sin(angle), -np.cos(angle), 0.0])
        cross = np.cross(along, wanted)
        quat = np.array([1 + along @ wanted, *cross])
        quats[arm] = quat / np.linalg.norm(quat)
    return _pose_once(avatar, quats)


def standing_pose(avatar: AvatarMesh) -> Float[np.ndarray, "v 3"]:
    """The first frame (v, 3) of standing idle, facing +z at the origin."""
    from avatarjax.data import clips

    idle = clips.load_clip("idle", avatar.rig)
    transforms = jax.jit(skinning.forward_kinematics)(avatar.rig, idle.quats[0], idle.hips[0])[None]
    vertices = pose_vertices(avatar, transforms, transforms)[0]
    return vertices - np.array([0, vertices[:, 1].min(), 0], np.float32)
