"""What of a body can be seen at all: not the inside of its mouth, nor the backs of its eye sockets."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def seen(
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
