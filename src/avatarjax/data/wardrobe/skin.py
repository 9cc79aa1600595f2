"""The skin of a body as a piece: parts of it, what of it can be seen at all, and how its muscles rise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from avatarjax.data.body import Body
from avatarjax.data.wardrobe import assembly
from avatarjax.data.wardrobe.garments import Piece

_SKIN = ("body", "helper-l-eye", "helper-r-eye")


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
    )


def visible_skin(body: Body, bare: Float[np.ndarray, "v 3"]) -> Piece:
    """The skin of the shaped body (v, 3) without what nobody can see."""
    whole = body_piece(body, bare, _SKIN, "body")
    shown = in_view(whole.vertices, whole.faces, assembly.vertex_normals(whole.vertices, whole.faces))
    # Faces go only where all of their surroundings are hidden.
    near = np.zeros_like(shown)
    near[whole.faces[shown[whole.faces].any(axis=1)]] = True
    keep = np.zeros(len(bare), bool)
    used = np.unique(body.faces[np.isin(body.parts, [body.groups.index(g) for g in _SKIN])])
    keep[used] = near
    return body_piece(body, bare, ("body",), "body", keep=keep)


def in_view(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], normals: Float[np.ndarray, "v 3"], rays: int = 24
) -> Bool[np.ndarray, " v"]:
    """Which vertices (v,), metres, see the sky past the faces (f, 3) along at least one of some rays."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices[faces], np.float32))
    # A golden spiral of directions, turned into the half space over each vertex.
    k = np.arange(rays) + 0.5
    turn, height = k * np.pi * (1 + 5**0.5), 1 - 2 * k / rays
    sphere = np.stack([np.cos(turn), np.sin(turn), height], axis=1)
    sphere[:, :2] *= np.sqrt(1 - height**2)[:, None]
    ways = np.repeat(sphere[None], len(vertices), axis=0)
    below = np.einsum("vrk,vk->vr", ways, normals)
    ways = ways - 2 * np.minimum(below, 0)[..., None] * normals[:, None]
    starts = np.repeat(vertices + 0.0005 * normals, rays, axis=0)
    hit = scene.run(starts.astype(np.float32), np.ascontiguousarray(ways.reshape(-1, 3), np.float32)) >= 0
    return ~hit.reshape(-1, rays).all(axis=1)


def relief(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rounds: int = 10
) -> Callable[[np.ndarray], np.ndarray]:
    """How hollow a skin is, as a function from points (n, 3) on it to metres (n,): positive in the furrows between
    muscles, negative on their bellies. `rounds` of smoothing tell the size of the forms, which are painted with it."""
    ones = np.ones(len(vertices), np.float32)
    smooth = assembly.relax(vertices, faces, ones, rounds)
    hollow = ((smooth - vertices) * assembly.vertex_normals(smooth, faces)).sum(1)
    tree = cKDTree(vertices)

    def at(p: np.ndarray) -> np.ndarray:
        distance, nearest = tree.query(p, k=4)
        share = 1 / (distance + 1e-4)
        return (hollow[nearest] * share).sum(1) / share.sum(1)

    return at
