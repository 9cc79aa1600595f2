"""What the readers hand to the door: meshes in their file's own unit and axes, checked for what every mesh must be."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path

import numpy as np

if typing.TYPE_CHECKING:
    from avatarjax.data.importers.gltf_animation import SkeletonAnimation


@dataclasses.dataclass(frozen=True, eq=False)
class Material:
    """How a part of a mesh is coloured: an image (h, w, 3) uint8 or, without one, one colour (3,) uint8; its name."""

    image: np.ndarray | None
    color: tuple[int, int, int]
    name: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class RawSequence:
    """Frames of one sequence: the chosen vertices (f, v, 3), the numbers of all frames as in the files, actions of all
    frames where the file holds them, and joints of the chosen frames where there are any."""

    name: str
    vertices: np.ndarray
    numbers: tuple[int, ...]
    actions: typing.Any = None
    joints: SkeletonAnimation | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class RawMesh:
    """Sequences of one mesh: faces (g, 3), uvs (g, 3, 2) with v up or None, the material of each face (g,), frames a
    second where the file says so, and the axes that its format prescribes."""

    sequences: tuple[RawSequence, ...]
    faces: np.ndarray
    uvs: np.ndarray | None
    materials: tuple[Material, ...]
    face_materials: np.ndarray
    source: str
    fps: float | None = None
    axes: str | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class RawFrame:
    """One mesh file: vertices (v, 3), faces (g, 3), uvs (g, 3, 2) or None, materials and which face has which (g,)."""

    vertices: np.ndarray
    faces: np.ndarray
    uvs: np.ndarray | None = None
    materials: tuple[Material, ...] = ()
    face_materials: np.ndarray | None = None


def check_vertices(vertices: np.ndarray, source: str | Path) -> np.ndarray:
    """Vertices (..., v, 3) as float32; ValueError that names the file for another shape, none, NaN or infinity."""
    if vertices.ndim < 2 or vertices.shape[-1] != 3 or not vertices.size or vertices.dtype.kind not in "fiu":
        raise ValueError(f"{source}: vertices must be numbers of shape (v, 3), got {vertices.dtype} {vertices.shape}")
    finite = np.isfinite(vertices)
    if not finite.all():
        where = np.argwhere(~finite)[0]
        place = f"frame {where[0]}, vertex {where[1]}" if vertices.ndim == 3 else f"vertex {where[0]}"
        raise ValueError(
            f"{source}: {place} is not finite (NaN or infinity): repair the simulation and export it again"
        )
    return vertices.astype(np.float32)


def check_faces(faces: np.ndarray, vertex_count: int, source: str | Path) -> np.ndarray:
    """Triangles (g, 3) as int32; ValueError that names the file for another shape, none, or an index out of range."""
    if faces.size == 0:
        raise ValueError(f"{source} has 0 faces: export triangles, not points or curves")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(
            f"{source}: faces must be integers of shape (g, 3), got {faces.dtype} {faces.shape}: triangulate"
        )
    if faces.min() < 0 or faces.max() >= vertex_count:
        raise ValueError(f"{source}: faces use vertices {faces.min()} to {faces.max()}, there are {vertex_count}")
    return faces.astype(np.int32)


def corner_uvs(uvs: np.ndarray | None, faces: np.ndarray, vertex_count: int, source: str | Path) -> np.ndarray | None:
    """Texture coordinates per corner (g, 3, 2) float32 from those per corner or per vertex (v, 2).

    ValueError names the file where their number is neither, or where one is not finite.
    """
    if uvs is None:
        return None
    if uvs.shape == (vertex_count, 2):
        uvs = uvs[faces]
    if uvs.shape != (len(faces), 3, 2):
        raise ValueError(
            f"{source}: texture coordinates of shape {uvs.shape} fit neither the {vertex_count} vertices nor the "
            f"{len(faces)} faces: give (v, 2) or (g, 3, 2)"
        )
    if not np.isfinite(uvs).all():
        raise ValueError(f"{source}: a texture coordinate is not finite: unwrap the mesh again")
    return uvs.astype(np.float32)
