"""What cloth and hair lie on: how far points are above it, and pushing them out of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.wardrobe import assembly
from avatarjax.data.wardrobe.garments import Piece


@dataclasses.dataclass(frozen=True, eq=False)
class Ground:
    """Closed surfaces as points (v, 3), metres, with outward normals (v, 3), far closer together than they are curved.

    There are two ways to ask. `height` and `clear` are for sheets that crawl over a surface point by point: the height
    changes smoothly. `clearance` and `hold_clear` are for whole lines and sheets that are roughly in place, and may
    start far inside: the clearance is the least over the nearest points.
    """

    points: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    tree: cKDTree

    @classmethod
    def at(cls, *surfaces: tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]]) -> Ground:
        """The ground of several surfaces, each (points, unit normals)."""
        points = np.concatenate([s[0] for s in surfaces]).astype(np.float64)
        normals = np.concatenate([s[1] for s in surfaces]).astype(np.float64)
        return cls(points, normals, cKDTree(points))

    @classmethod
    def of(cls, pieces: Sequence[Piece]) -> Ground:
        """The ground that some pieces make together, with points all over their triangles."""
        # The corners, the middles of the edges, and the centre of each triangle.
        mixes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1], [1, 1, 1]], float)
        mixes /= mixes.sum(1, keepdims=True)
        surfaces = []
        for piece in pieces:
            smooth = assembly.vertex_normals(piece.vertices, piece.faces).astype(np.float64)
            normals = np.einsum("mk,fkd->fmd", mixes, smooth[piece.faces]).reshape(-1, 3)
            normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
            surfaces.append((np.einsum("mk,fkd->fmd", mixes, piece.vertices[piece.faces]).reshape(-1, 3), normals))
        return cls.at(*surfaces)

    def height(self, p: Float[np.ndarray, "n 3"], count: int = 5) -> tuple[np.ndarray, np.ndarray]:
        """Metres (n,) that points are above the nearest surface, and the surface's normals there (n, 3)."""
        distance, nearest = self.tree.query(p, k=count)
        share = 1 / np.maximum(distance, 1e-4) ** 2
        share = (share / share.sum(1, keepdims=True))[..., None]
        normal = (self.normals[nearest] * share).sum(1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return ((p - (self.points[nearest] * share).sum(1)) * normal).sum(1), normal

    def clear(self, p: Float[np.ndarray, "n 3"], gap: np.ndarray | float, rounds: int = 6) -> np.ndarray:
        """The points (n, 3), pushed out until every one of its near neighbours on the surface is `gap` metres below."""
        p, gap = p.copy(), np.broadcast_to(np.asarray(gap, float), len(p))
        for _ in range(rounds):
            _, nearest = self.tree.query(p, k=8)
            offset = p[:, None] - self.points[nearest]
            normal = self.normals[nearest]
            height = (offset * normal).sum(-1)
            across = np.linalg.norm(offset - height[..., None] * normal, axis=-1)
            # A neighbour's tangent plane speaks only for its surroundings, and not for the other side of a limb.
            lack = np.clip(gap[:, None] - height, 0, 0.05) * (across < 0.03) * (height > -0.08)
            worst = lack.argmax(1)[:, None]
            p += np.take_along_axis(normal, worst[..., None], 1)[:, 0] * np.take_along_axis(lack, worst, 1)
        return p

    def clearance(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Metres (n,) of points outside the nearest points, along their normals (n, 3); negative inside."""
        _, nearest = self.tree.query(points, k=3)
        normal = self.normals[nearest].mean(1)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return ((points[:, None] - self.points[nearest]) * normal[:, None]).sum(-1).min(1), normal

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
