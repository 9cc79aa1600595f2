"""The ground-truth picture of a textured mesh: first hits of camera rays (embreex), texture and a mild fixed light."""

from __future__ import annotations

import dataclasses
import typing

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse

from avatarjax.cameras import Camera

# A sky brighter than the ground and one soft lamp, fixed in the world so that a turning figure shades differently.
_SKY, _GROUND, _LAMP = 0.80, 0.52, 0.34
_LAMP_DIRECTION = np.array([0.45, 0.65, 0.62], np.float32) / np.linalg.norm([0.45, 0.65, 0.62])


def sample_texture(texture: UInt8[np.ndarray, "h w 3"], uvs: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Bilinear colours (n, 3) in 0..255 at texture coordinates (n, 2): u to the right, v up, clamped at the border."""
    height, width, _ = texture.shape
    x = np.clip(uvs[:, 0] * width - 0.5, 0, width - 1.001)
    y = np.clip((1 - uvs[:, 1]) * height - 0.5, 0, height - 1.001)
    column, row = x.astype(np.int32), y.astype(np.int32)
    fx, fy = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
    flat = texture.reshape(-1, 3)
    corner = row * width + column
    top = flat[corner] * (1 - fx) + flat[corner + 1] * fx
    bottom = flat[corner + width] * (1 - fx) + flat[corner + width + 1] * fx
    return top * (1 - fy) + bottom * fy


class MeshRenderer:
    """Draws poses of one mesh: triangles (f, 3), their corners' texture coordinates (f, 3, 2), a texture (h, w, 3).

    Raises ValueError where the arrays do not fit each other.
    """

    def __init__(
        self,
        faces: Int[np.ndarray, "f 3"],
        uvs: Float[np.ndarray, "g 3 2"],
        texture: UInt8[np.ndarray, "h w 3"],
    ) -> None:
        if len(faces) == 0 or len(uvs) != len(faces):
            raise ValueError(f"need texture coordinates for each of the {len(faces)} triangles, got {len(uvs)}")
        self.faces, self.uvs, self.texture = faces, uvs, texture
        # embreex asks for one index after the other: of a tuple that is twice as fast as of a row of an array.
        self._triples = np.empty(len(faces), object)
        self._triples[:] = list(map(tuple, faces.tolist()))
        corners = faces.ravel()
        ones = np.ones(len(corners), np.float32)
        triangles = np.repeat(np.arange(len(faces)), 3)
        # Summing the normals of the triangles around a vertex is a product with this matrix.
        self._around = sparse.csr_matrix((ones, (corners, triangles)), shape=(corners.max() + 1, len(faces)))

    def vertex_normals(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
        """Unit normals (v, 3), means of the triangles around each vertex, weighted by their area."""
        a, b, c = (vertices[self.faces[:, k]] for k in range(3))
        normals = self._around @ np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def pose(self, vertices: Float[np.ndarray, "v 3"]) -> PosedMesh:
        """The mesh in one pose, ready for any number of views. Raises ValueError for vertices that are not finite."""
        vertices = np.ascontiguousarray(vertices, np.float32)
        if not np.isfinite(vertices).all():
            raise ValueError("the mesh has vertices that are not finite")
        return PosedMesh(self, vertices, self.vertex_normals(vertices), _scene(vertices, self._triples))

    def render(
        self, vertices: Float[np.ndarray, "v 3"], camera: Camera, supersample: int = 2
    ) -> UInt8[np.ndarray, "h w 4"]:
        """One view of one pose: `pose(vertices).render(camera, supersample)`."""
        return self.pose(vertices).render(camera, supersample)


@dataclasses.dataclass(frozen=True, eq=False)
class PosedMesh:
    """One pose of a mesh with its ray-casting structure: vertices and unit normals (v, 3)."""

    renderer: MeshRenderer
    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    scene: typing.Any

    def render(self, camera: Camera, supersample: int = 2) -> UInt8[np.ndarray, "h w 4"]:
        """One view as straight-alpha RGBA; `supersample` squared rays fall on a pixel."""
        renderer = self.renderer
        pixels, origin, directions = _rays(self.vertices, camera, supersample)
        hits = self.scene.run(np.tile(origin, (len(directions), 1)), directions, output=1)
        struck = np.flatnonzero(hits["primID"] >= 0)
        face, u, v = hits["primID"][struck], hits["u"][struck], hits["v"][struck]
        bary = np.stack([1 - u - v, u, v], axis=1).astype(np.float32)
        colour = sample_texture(renderer.texture, np.einsum("nc,ncd->nd", bary, renderer.uvs[face]))
        normal = np.einsum("nc,ncd->nd", bary, self.normals[renderer.faces[face]])
        colour *= _light(normal, directions[struck])[:, None]

        width, height = camera.width, camera.height
        cell = pixels[struck]
        count = np.bincount(cell, minlength=width * height)
        total = np.stack([np.bincount(cell, colour[:, k], minlength=width * height) for k in range(3)], axis=1)
        image = np.zeros((height * width, 4), np.uint8)
        seen = count > 0
        image[seen, :3] = np.clip(np.round(total[seen] / count[seen, None]), 0, 255)
        image[:, 3] = np.round(count * (255 / supersample**2))
        return image.reshape(height, width, 4)


def _rays(vertices: np.ndarray, camera: Camera, supersample: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel number (n,), common origin (3,) and directions (n, 3) of the rays that can meet the mesh's bounding box."""
    world_to_camera = np.asarray(camera.world_to_camera, np.float64)
    intrinsics = np.asarray(camera.intrinsics, np.float64)
    rotation, shift = world_to_camera[:3, :3], world_to_camera[:3, 3]
    points = vertices @ rotation.T + shift
    low, high = np.zeros(2), np.array([camera.width, camera.height], np.float64)
    if points[:, 2].min() > 1e-3:
        image = points @ intrinsics.T
        image = image[:, :2] / image[:, 2:]
        low, high = np.maximum(low, np.floor(image.min(0))), np.minimum(high, np.ceil(image.max(0)))
    size = np.maximum(high - low, 0).astype(int) * supersample
    x = low[0] + (np.arange(size[0]) + 0.5) / supersample
    y = low[1] + (np.arange(size[1]) + 0.5) / supersample
    across, down, ahead = (np.linalg.inv(intrinsics).T @ rotation).astype(np.float32)
    rows = y.astype(np.float32)[:, None] * down + ahead
    directions = rows[:, None] + (x.astype(np.float32)[:, None] * across)[None]
    pixels = np.floor(y).astype(int)[:, None] * camera.width + np.floor(x).astype(int)[None]
    return pixels.ravel(), (-rotation.T @ shift).astype(np.float32), directions.reshape(-1, 3)


def _scene(vertices: np.ndarray, triples: np.ndarray) -> typing.Any:
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices, triples)
    return scene


def _light(normals: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Brightness (n,) of surface points with normals (n, 3), not unit, seen along directions (n, 3)."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # Cloth and hair are open surfaces: the side that faces the camera is lit.
    normals = normals * np.where((normals * directions).sum(1) > 0, -1, 1)[:, None]
    sky = _GROUND + (_SKY - _GROUND) * (0.5 + 0.5 * normals[:, 1])
    wrapped = np.clip((normals @ _LAMP_DIRECTION + 0.3) / 1.3, 0, 1)
    return (sky + _LAMP * wrapped).astype(np.float32)
