"""Cutting and fitting pieces: clipped along a smooth line, let out, spanned over hollows, subdivided and joined."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse import linalg

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


def let_out(piece: Piece, thickness: np.ndarray | float, smooth: np.ndarray | float = 0.6, rounds: int = 8) -> Piece:
    """The piece relaxed, by `smooth` in [0, 1] a round, and then moved outwards by `thickness` metres; both are () or
    (v,)."""
    share = np.broadcast_to(np.asarray(smooth, np.float32), (len(piece.vertices),))
    vertices = assembly.relax(piece.vertices, piece.faces, share, rounds)
    normals = assembly.vertex_normals(vertices, piece.faces)
    out = vertices + normals * np.broadcast_to(thickness, (len(vertices),))[:, None]
    return dataclasses.replace(piece, vertices=out.astype(np.float32))


def span(piece: Piece, over: Bool[np.ndarray, " v"]) -> Piece:
    """The piece with some of its vertices, `over` (v,), drawn tight as a membrane between the others, as cloth or hair
    is over a hollow, a nipple or an ear."""
    count, faces = len(piece.vertices), piece.faces
    graph = assembly.neighbours(faces, count)
    laplacian = (sparse.diags(np.asarray(graph.sum(1)).ravel()) - graph).tocsr()[over]
    fixed = piece.vertices[~over].astype(np.float64)
    vertices = piece.vertices.copy()
    vertices[over] = linalg.spsolve(laplacian[:, over].tocsc(), -(laplacian[:, ~over] @ fixed))
    return dataclasses.replace(piece, vertices=vertices)


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


def spread_uvs(piece: Piece, margin: float = 0.01) -> Piece:
    """The piece's corner of a uv square, spread over a square of its own but for a `margin`."""
    low, high = piece.uvs.min(axis=(0, 1)), piece.uvs.max(axis=(0, 1))
    spread = margin + (piece.uvs - low) / (high - low) * (1 - 2 * margin)
    return dataclasses.replace(piece, uvs=spread.astype(np.float32))


def join(name: str, parts: Sequence[Piece], places: Sequence[tuple[float, float, float, float]] | None = None) -> Piece:
    """One solid piece of cotton of several, each with the place (u0, v0, u1, v1) of its uv square in that of the whole;
    without places all have the whole of it."""
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])[:-1]
    corners = np.array(places if places else [(0, 0, 1, 1)] * len(parts), np.float32)
    reaches = [np.zeros(len(part.vertices), np.float32) if part.reach is None else part.reach for part in parts]
    braces = [part.braces + start for part, start in zip(parts, starts, strict=True) if part.braces is not None]
    return Piece(
        name,
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        np.concatenate([at[:2] + part.uvs * (at[2:] - at[:2]) for part, at in zip(parts, corners, strict=True)]).astype(
            np.float32
        ),
        np.concatenate([part.weights for part in parts]),
        np.concatenate(reaches),
        np.concatenate(braces).astype(np.int32) if braces else None,
    )
