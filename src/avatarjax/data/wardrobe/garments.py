"""What every garment is made of: the piece, its grid of triangles, and the outline of what it goes around."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from avatarjax.data.wardrobe import fabrics
from avatarjax.physics.cloth import Fabric

# A number, or one for each element.
_Edge = np.ndarray | np.floating | float


@dataclasses.dataclass(frozen=True, eq=False)
class Piece:
    """A part of an avatar in its rest pose, which for cloth is also its pattern: the lengths it keeps.

    vertices (v, 3) metres; faces (f, 3); uvs (f, 3, 2) corners in the unit square of the piece, for cloth along its
    threads; weights (v, j), rows sum to 1; reach (v,) metres that a vertex may leave the place where the skeleton
    carries it: 0 rides on the bones, more is simulated as `fabric`; braces (b, 2) pairs of vertices that keep their
    distance though no edge joins them (a braid stays round); solid: cloth collides with this piece.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "f 3 2"]
    weights: Float[np.ndarray, "v j"]
    reach: Float[np.ndarray, " v"] | None = None
    braces: Int[np.ndarray, "b 2"] | None = None
    fabric: Fabric = fabrics.COTTON
    solid: bool = True


def grid_faces(rows: int, columns: int, *, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (f, 3) of a grid of rows x columns vertices and their corner uvs (f, 3, 2); closed joins the last
    column to the first. u runs along the columns, v from 1 at the first row to 0 at the last. Seen with rows going
    down and columns going counter-clockwise about +y (from +z to +x), the triangles face outwards."""
    quads = columns if closed else columns - 1
    r, c = (a.ravel() for a in np.meshgrid(np.arange(rows - 1), np.arange(quads), indexing="ij"))
    corner_rows = np.stack([r, r + 1, r + 1, r], axis=1)
    corner_columns = np.stack([c, c, c + 1, c + 1], axis=1)
    vertex = corner_rows * columns + corner_columns % columns
    uv = np.stack([corner_columns / quads, 1 - corner_rows / (rows - 1)], axis=-1).astype(np.float32)
    faces = np.concatenate([vertex[:, [0, 1, 2]], vertex[:, [0, 2, 3]]])
    return faces.astype(np.int32), np.concatenate([uv[:, [0, 1, 2]], uv[:, [0, 2, 3]]])


def facing_out(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, uvs: np.ndarray, middle: Float[np.ndarray, "_ 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The faces (f, 3) and uvs (f, 3, 2), turned over if they look towards the `middle`, (v, 3) or (1, 3), that each
    vertex (v, 3) lies around."""
    corner = vertices[faces]
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inside = np.broadcast_to(middle, vertices.shape)[faces].mean(1)
    if (flat * (corner.mean(1) - inside)).sum() < 0:
        faces, uvs = faces[:, [0, 2, 1]], uvs[:, [0, 2, 1]]
    return faces, uvs


def smoothstep(x: np.ndarray, low: _Edge, high: _Edge) -> np.ndarray:
    """0 below low, 1 above high (or the other way round where high < low), smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def outline(points: np.ndarray, centre: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distance (k,) of the convex outline of points (n, 2) from a centre, along directions (sin, cos) of angles
    (k,)."""
    directions = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    support = ((points - centre) @ directions.T).max(axis=0)
    # The convex outline is the intersection of its supporting half-planes.
    facing = directions @ directions.T
    reach = np.where(facing > 0.05, support[None] / np.maximum(facing, 0.05), np.inf)
    return reach.min(axis=1)
