"""Putting an avatar together: pieces of geometry and their painters become one mesh with one texture atlas."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import textures
from avatarjax.data.wardrobe.garments import Piece
from avatarjax.physics.cloth import Fabric


@dataclasses.dataclass(frozen=True, eq=False)
class Layer:
    """A piece, the place of its unit uv square in the atlas (u0, v0, u1, v1), and who paints it."""

    piece: Piece
    place: tuple[float, float, float, float]
    paint: textures.Painter


@dataclasses.dataclass(frozen=True, eq=False)
class AvatarMesh:
    """A dressed, painted figure in its rest pose as NumPy arrays, metres; the same vertices and faces in every frame.

    vertices (v, 3); faces (f, 3); uvs (f, 3, 2) of each triangle's corners, v up; texture (h, w, 3) sRGB; parts (f,)
    index into part_names; weights (v, j), rows sum to 1; reach (v,), braces (b, 2): see `Piece`; fabrics and solid, one
    a part; rig.
    """

    name: str
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "f 3 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    parts: Int[np.ndarray, " f"]
    part_names: tuple[str, ...]
    weights: Float[np.ndarray, "v j"]
    reach: Float[np.ndarray, " v"]
    braces: Int[np.ndarray, "b 2"]
    fabrics: tuple[Fabric, ...]
    solid: tuple[bool, ...]
    rig: Rig


def vertex_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Unit normals (v, 3): area-weighted means of the triangles around each vertex."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    normals = np.stack([np.bincount(faces.ravel(), np.repeat(flat[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def neighbours(faces: Int[np.ndarray, "f 3"], count: int) -> sparse.csr_matrix:
    """The sparse matrix (count, count) that is 1 where an edge of the faces joins two vertices, both ways."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    return ((graph + graph.T) > 0).astype(np.float64)


def relax(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], share: Float[np.ndarray, " v"], rounds: int
) -> Float[np.ndarray, "v 3"]:
    """Laplacian smoothing: each round moves a vertex by its share in [0, 1] towards the mean of its neighbours."""
    around = neighbours(faces, len(vertices))
    around = sparse.diags(1 / np.maximum(np.asarray(around.sum(1)).ravel(), 1)) @ around
    moved = vertices.astype(np.float64)
    for _ in range(rounds):
        moved = moved + (around @ moved - moved) * share[:, None]
    return moved.astype(np.float32)


def assemble(name: str, rig: Rig, layers: list[Layer], *, sole: float = 0.0, size: int = 1024) -> AvatarMesh:
    """One mesh and atlas (size, size) of layers, in their order; what is on the feet is `sole` metres thick below
    them."""
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
    none = np.zeros((0, 2), np.int32)
    pieces = [layer.piece for layer in layers]
    reaches = [np.zeros(len(p.vertices), np.float32) if p.reach is None else p.reach for p in pieces]
    braces = [none if p.braces is None else p.braces + start for p, start in zip(pieces, starts, strict=False)]
    return AvatarMesh(
        name=name,
        vertices=vertices,
        faces=faces.astype(np.int32),
        uvs=uvs,
        texture=textures.paint_atlas(vertices, normals, faces, uvs, own, parts, painters, size),
        parts=parts,
        part_names=tuple(p.name for p in pieces),
        weights=np.concatenate([p.weights for p in pieces]).astype(np.float32),
        reach=np.concatenate(reaches),
        braces=np.concatenate(braces).astype(np.int32),
        fabrics=tuple(p.fabric for p in pieces),
        solid=tuple(p.solid for p in pieces),
        rig=rig.replace(soles=rig.soles - np.array([0, sole, 0], np.float32)),
    )
