"""Cutting and fitting: clipping a piece along a smooth line, letting it out, and holding cloth clear of what is under
it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import assembly
from avatarjax.data.wardrobe.garments import Piece

# A cut this close to a vertex (share of the edge) moves the vertex, so that no sliver is left over.
_SNAP = 0.3


def clip(piece: Piece, level: Float[np.ndarray, " v"]) -> Piece:
    """The part of a piece without reach or braces where `level` (v,), a smooth function on it, is positive; the cut
    runs exactly along level 0, through triangles."""
    vertices, weights = piece.vertices.astype(np.float64), piece.weights.astype(np.float64)
    level = level.astype(np.float64).copy()
    edges = np.concatenate([piece.faces[:, [0, 1]], piece.faces[:, [1, 2]], piece.faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    a, b = edges[(level[edges[:, 0]] > 0) != (level[edges[:, 1]] > 0)].T
    t = level[a] / (level[a] - level[b])
    moved, count = np.zeros_like(vertices), np.zeros(len(vertices))
    for near, far, share in ((a, b, t), (b, a, 1 - t)):
        close = share < _SNAP
        np.add.at(
            moved, near[close], vertices[near[close]] + share[close, None] * (vertices[far] - vertices[near])[close]
        )
        np.add.at(count, near[close], 1)
    snapped = count > 0
    vertices[snapped] = moved[snapped] / count[snapped, None]
    level[snapped] = 0

    new: dict[tuple[int, int], int] = {}
    points, rows, faces, uvs = list(vertices), list(weights), [], []
    above = level >= 0
    for face, corner in zip(piece.faces, piece.uvs, strict=True):
        if not (level[face] > 0).any():
            continue
        if above[face].all():
            faces.append(face)
            uvs.append(corner)
            continue
        polygon, where = [], []
        for k in range(3):
            i, j, p, q = face[k], face[(k + 1) % 3], corner[k], corner[(k + 1) % 3]
            if above[i]:
                polygon.append(i)
                where.append(p)
            if level[i] * level[j] < 0:
                key = (min(i, j), max(i, j))
                low, high = key
                share = level[low] / (level[low] - level[high])
                if key not in new:
                    new[key] = len(points)
                    points.append(vertices[low] + share * (vertices[high] - vertices[low]))
                    rows.append(weights[low] + share * (weights[high] - weights[low]))
                polygon.append(new[key])
                where.append(p + (share if low == i else 1 - share) * (q - p))
        for k in range(1, len(polygon) - 1):
            faces.append([polygon[0], polygon[k], polygon[k + 1]])
            uvs.append([where[0], where[k], where[k + 1]])
    used, index = np.unique(np.array(faces), return_inverse=True)
    return dataclasses.replace(
        piece,
        vertices=np.array(points)[used].astype(np.float32),
        faces=index.reshape(-1, 3).astype(np.int32),
        uvs=np.array(uvs, np.float32),
        weights=np.array(rows)[used].astype(np.float32),
    )


def spread_uvs(piece: Piece, margin: float = 0.01) -> Piece:
    """The piece's corner of a uv square, spread over a square of its own but for a `margin`."""
    low, high = piece.uvs.min(axis=(0, 1)), piece.uvs.max(axis=(0, 1))
    spread = margin + (piece.uvs - low) / (high - low) * (1 - 2 * margin)
    return dataclasses.replace(piece, uvs=spread.astype(np.float32))


def let_out(piece: Piece, thickness: np.ndarray | float, smooth: float = 0.6, rounds: int = 8) -> Piece:
    """The piece relaxed (`smooth` in [0, 1] a round) and then moved outwards by `thickness` () or (v,) metres."""
    share = np.full(len(piece.vertices), smooth, np.float32)
    vertices = assembly.relax(piece.vertices, piece.faces, share, rounds)
    normals = assembly.vertex_normals(vertices, piece.faces)
    out = vertices + normals * np.broadcast_to(thickness, (len(vertices),))[:, None]
    return dataclasses.replace(piece, vertices=out.astype(np.float32))


@dataclasses.dataclass(frozen=True, eq=False)
class Ground:
    """Solid pieces that cloth stays clear of: places (n, 3) all over their surfaces, and the normals (n, 3) there."""

    places: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tree: cKDTree

    @classmethod
    def of(cls, pieces: Sequence[Piece]) -> Ground:
        """The ground that some pieces make together."""
        # The corners, the middles of the edges, and the centre of each triangle.
        mixes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1], [1, 1, 1]], float)
        mixes /= mixes.sum(1, keepdims=True)
        places, normals = [], []
        for piece in pieces:
            smooth = assembly.vertex_normals(piece.vertices, piece.faces).astype(np.float64)
            places.append(np.einsum("mk,fkd->fmd", mixes, piece.vertices[piece.faces]).reshape(-1, 3))
            normals.append(np.einsum("mk,fkd->fmd", mixes, smooth[piece.faces]).reshape(-1, 3))
        place, normal = np.concatenate(places), np.concatenate(normals)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return cls(place, normal, cKDTree(place))

    def clearance(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Metres (n,) of points outside the nearest places, along their normals (n, 3); negative inside."""
        _, nearest = self.tree.query(points, k=3)
        normal = self.normals[nearest].mean(1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return ((points[:, None] - self.places[nearest]) * normal[:, None]).sum(-1).min(1), normal

    def hold_clear(
        self, points: Float[np.ndarray, "n 3"], margin: np.ndarray | float, rounds: int = 3, deepest: float = 0.06
    ) -> Float[np.ndarray, "n 3"]:
        """Points (n, 3) pushed out until they are `margin` metres, () or (n,), away; what lies deeper than `deepest`
        metres is taken to be beyond the far side, and left."""
        moved = points.astype(np.float64)
        for _ in range(rounds):
            depth, normal = self.clearance(moved)
            push = np.where(depth > -deepest, np.clip(margin - depth, 0, deepest), 0)
            moved = moved + normal * push[:, None]
        return moved


def bones(rig: Rig, *words: str) -> list[int]:
    """The joint numbers whose names contain one of the words."""
    return [i for i, name in enumerate(rig.names) if any(word in name for word in words)]


def subdivide(piece: Piece) -> Piece:
    """The same surface with each triangle cut into four; for a piece without reach or braces."""
    faces = piece.faces
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    pairs, middle = np.unique(edges, axis=0, return_inverse=True)
    middle = middle.reshape(-1, 3) + len(piece.vertices)
    half = (piece.uvs + np.roll(piece.uvs, -1, axis=1)) / 2
    fan = [[(0, 0), (1, 0), (1, 2)], [(0, 1), (1, 1), (1, 0)], [(0, 2), (1, 2), (1, 1)], [(1, 0), (1, 1), (1, 2)]]
    both, at = (faces, middle), (piece.uvs, half)
    return dataclasses.replace(
        piece,
        vertices=np.concatenate([piece.vertices, piece.vertices[pairs].mean(1)]),
        faces=np.concatenate([np.stack([both[m][:, k] for m, k in f], axis=1) for f in fan]).astype(np.int32),
        uvs=np.concatenate([np.stack([at[m][:, k] for m, k in f], axis=1) for f in fan]),
        weights=np.concatenate([piece.weights, piece.weights[pairs].mean(1)]),
    )


def join(name: str, parts: list[tuple[Piece, tuple[float, float, float, float]]]) -> Piece:
    """One solid piece of rigid parts, each with the place (u0, v0, u1, v1) of its uv square in that of the whole."""
    starts = np.cumsum([0] + [len(part.vertices) for part, _ in parts])
    places = [np.array(place, np.float32) for _, place in parts]
    return Piece(
        name,
        np.concatenate([part.vertices for part, _ in parts]),
        np.concatenate([part.faces + start for (part, _), start in zip(parts, starts, strict=False)]).astype(np.int32),
        np.concatenate(
            [at[:2] + part.uvs * (at[2:] - at[:2]) for (part, _), at in zip(parts, places, strict=True)]
        ).astype(np.float32),
        np.concatenate([part.weights for part, _ in parts]),
    )
