"""Putting an avatar together: pieces of geometry and their painters become one mesh with one texture atlas."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse

from avatarjax.data import textures
from avatarjax.data.body import Body, Rig
from avatarjax.data.garments import Drape, Piece


@dataclasses.dataclass(frozen=True, eq=False)
class Layer:
    """A piece, the place of its unit uv square in the atlas (u0, v0, u1, v1), and who paints it."""

    piece: Piece
    place: tuple[float, float, float, float]
    paint: textures.Painter


@dataclasses.dataclass(frozen=True, eq=False)
class Look:
    """A dressed, painted figure: the arrays of an `AvatarMesh`. The vertices of `drape`, if any, are the last."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "f 3 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    parts: Int[np.ndarray, " f"]
    part_names: tuple[str, ...]
    weights: Float[np.ndarray, "v j"]
    lag: Float[np.ndarray, " v"]
    rig: Rig
    drape: Drape | None


def body_piece(
    body: Body, vertices: Float[np.ndarray, "v 3"], groups: tuple[str, ...], name: str, keep: np.ndarray | None = None
) -> Piece:
    """Some groups of the shaped body as triangles; `keep` (v,) bool drops every face that has a vertex not kept."""
    chosen = np.isin(body.parts, [body.groups.index(g) for g in groups])
    if keep is not None:
        chosen &= keep[body.faces].all(axis=1)
    quads, corners = body.faces[chosen], body.uvs[body.uv_faces[chosen]]
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    uvs = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    used, faces = np.unique(triangles, return_inverse=True)
    return Piece(
        name,
        vertices[used].astype(np.float32),
        faces.reshape(-1, 3).astype(np.int32),
        uvs,
        body.skin_weights[used],
        np.zeros(len(used), np.float32),
    )


def vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals (v, 3): area-weighted means of the triangles around each vertex."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    normals = np.stack([np.bincount(faces.ravel(), np.repeat(flat[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def relax(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], share: Float[np.ndarray, " v"], rounds: int
) -> Float[np.ndarray, "v 3"]:
    """Laplacian smoothing: each round moves a vertex by its share in [0, 1] towards the mean of its neighbours."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ones = np.ones(len(edges))
    around = sparse.coo_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2).tocsr()
    around = ((around + around.T) > 0).astype(np.float64)
    around = sparse.diags(1 / np.maximum(np.asarray(around.sum(1)).ravel(), 1)) @ around
    moved = vertices.astype(np.float64)
    for _ in range(rounds):
        moved = moved + (around @ moved - moved) * share[:, None]
    return moved.astype(np.float32)


def assemble(rig: Rig, layers: list[Layer], drape: Drape | None, size: int = 1024) -> Look:
    """One mesh and atlas (size, size) of layers, in their order; the draped layer must be the last."""
    starts = np.cumsum([0] + [len(layer.piece.vertices) for layer in layers])
    vertices = np.concatenate([layer.piece.vertices for layer in layers]).astype(np.float32)
    faces = np.concatenate([layer.piece.faces + start for layer, start in zip(layers, starts, strict=False)])
    own = np.concatenate([layer.piece.uvs for layer in layers]).astype(np.float32)
    parts = np.repeat(np.arange(len(layers)), [len(layer.piece.faces) for layer in layers]).astype(np.int32)
    low = np.array([layer.place[:2] for layer in layers], np.float32)[parts][:, None]
    high = np.array([layer.place[2:] for layer in layers], np.float32)[parts][:, None]
    # Half a texel inwards on every side, so that neighbouring pieces do not share texels.
    inset = 1.0 / size
    uvs = low + inset + own * (high - low - 2 * inset)
    normals = vertex_normals(vertices, faces)
    painters = [layer.paint for layer in layers]
    return Look(
        vertices=vertices,
        faces=faces.astype(np.int32),
        uvs=uvs,
        texture=textures.paint_atlas(vertices, normals, faces, uvs, own, parts, painters, size),
        parts=parts,
        part_names=tuple(layer.piece.name for layer in layers),
        weights=np.concatenate([layer.piece.weights for layer in layers]).astype(np.float32),
        lag=np.concatenate([layer.piece.lag for layer in layers]).astype(np.float32),
        rig=rig,
        drape=drape,
    )
