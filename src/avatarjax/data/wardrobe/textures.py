"""One texture atlas for all pieces of an avatar, painted as a function of the rest position on the surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import ndimage

# A painter gets rest positions (n, 3), unit normals (n, 3) and uvs (n, 2) of the piece, and returns sRGB (n, 3) in
# 0..255.
Painter = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def surface_points(
    uvs: Float[np.ndarray, "f 3 2"], size: int
) -> tuple[Int[np.ndarray, "h w"], Float[np.ndarray, "h w 3"]]:
    """Which triangle covers the centre of each texel of a size x size texture (-1: none), and where (barycentric)."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    flat = np.concatenate([uvs, np.zeros((*uvs.shape[:2], 1))], axis=-1)
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(flat, np.float32))
    centres = (np.arange(size) + 0.5) / size
    origins = np.stack([*np.meshgrid(centres, 1 - centres), np.ones((size, size))], axis=-1).reshape(-1, 3)
    down = np.broadcast_to(np.array([0, 0, -1], np.float32), origins.shape)
    hits = scene.run(origins.astype(np.float32), np.ascontiguousarray(down), output=1)
    u, v = hits["u"], hits["v"]
    bary = np.stack([1 - u - v, u, v], axis=-1).reshape(size, size, 3)
    return hits["primID"].reshape(size, size).astype(np.int32), bary.astype(np.float32)


def paint_atlas(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    uvs: Float[np.ndarray, "f 3 2"],
    own_uvs: Float[np.ndarray, "f 3 2"],
    parts: Int[np.ndarray, " f"],
    painters: list[Painter],
    size: int,
) -> UInt8[np.ndarray, "size size 3"]:
    """The atlas (size, size, 3): the texels of part k are painted by painters[k]; gaps take the nearest painted colour,
    so that bilinear lookups at a seam find no background. `uvs` are places in the atlas, `own_uvs` in the piece."""
    face, bary = surface_points(uvs, size)
    covered = face >= 0
    face, bary = face[covered], bary[covered]

    def spread(corners: np.ndarray) -> np.ndarray:
        return np.einsum("nc,ncd->nd", bary, corners)

    position, normal, own = spread(vertices[faces[face]]), spread(normals[faces[face]]), spread(own_uvs[face])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    colour = np.zeros((len(face), 3))
    for part, painter in enumerate(painters):
        mine = parts[face] == part
        colour[mine] = painter(position[mine], normal[mine], own[mine])
    atlas = np.zeros((size, size, 3), np.uint8)
    atlas[covered] = np.clip(np.round(colour), 0, 255)
    nearest = np.asarray(ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True))
    return atlas[nearest[0], nearest[1]]


def noise(points: Float[np.ndarray, "n 3"], wavelength: float, seed: int = 0) -> Float[np.ndarray, " n"]:
    """Smooth value noise in [-1, 1] of points in space (metres); `wavelength` (metres) is the size of its features."""
    lattice = np.random.default_rng(seed).uniform(-1, 1, (16, 16, 16))
    return ndimage.map_coordinates(lattice, (points / wavelength).T, order=1, mode="grid-wrap")


def mix(below: np.ndarray, above: np.ndarray, share: np.ndarray | float) -> np.ndarray:
    """`share` (n,) in [0, 1] of the colour above over the colour below."""
    share = np.asarray(share)[..., None]
    return below * (1 - share) + above * share
