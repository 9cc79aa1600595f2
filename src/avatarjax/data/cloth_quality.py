"""How well simulated cloth behaves: how deep it lies in the body, how far it is stretched."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.wardrobe.assembly import AvatarMesh, vertex_normals

# Metres: how far over the body's surface a nearest vertex may lie aside and still say what is inside.
_ASIDE = 0.03


def simulated_faces(avatar: AvatarMesh) -> np.ndarray:
    """Which triangles (f,) bool have a vertex that is simulated."""
    return np.any(avatar.reach[avatar.faces] > 0, axis=1)


def penetration(avatar: AvatarMesh, frames: Float[np.ndarray, "f v 3"]) -> Float[np.ndarray, "f p"]:
    """Metres that each simulated vertex and each centre of a cloth triangle lies inside solid parts, frame by frame.

    Measured against the skinned mesh itself, not against what the simulation collides with: the height over the plane
    of the nearest vertex of a solid part, 0 where it is outside.
    """
    cloth = simulated_faces(avatar)
    solid_parts = np.flatnonzero(np.array(avatar.solid))
    solid = np.isin(avatar.parts, solid_parts) & ~np.isin(avatar.parts, avatar.parts[cloth])
    used, own = np.unique(avatar.faces[solid], return_inverse=True)
    own = own.reshape(-1, 3)
    free = np.flatnonzero(avatar.reach > 0)
    triangles = avatar.faces[cloth]
    depths = []
    for vertices in frames:
        points = vertices[used]
        normals = vertex_normals(points, own)
        queries = np.concatenate([vertices[free], vertices[triangles].mean(axis=1)])
        _, near = cKDTree(points).query(queries)
        offset = queries - points[near]
        height = (offset * normals[near]).sum(1)
        aside = np.sqrt(np.maximum((offset**2).sum(1) - height**2, 0))
        depths.append(np.where(aside < _ASIDE, np.maximum(-height, 0), 0))
    return np.stack(depths).astype(np.float32)


def simulated_parts(avatar: AvatarMesh) -> tuple[str, ...]:
    """The names of the parts that have simulated vertices."""
    return tuple(avatar.part_names[k] for k in np.unique(avatar.parts[simulated_faces(avatar)]))


def strain(avatar: AvatarMesh, frames: Float[np.ndarray, "f v 3"], part: str | None = None) -> Float[np.ndarray, "f e"]:
    """Relative change |l / l0 - 1| of the length of every edge of the cloth, or of one `part` of it, against the rest
    pose, frame by frame."""
    chosen = simulated_faces(avatar)
    if part is not None:
        chosen &= avatar.parts == avatar.part_names.index(part)
    faces = avatar.faces[chosen]
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    edges = edges[(avatar.reach[edges] > 0).any(axis=1)]

    def lengths(vertices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)

    rest = lengths(avatar.vertices)
    return np.stack([np.abs(lengths(vertices) / rest - 1) for vertices in frames]).astype(np.float32)
