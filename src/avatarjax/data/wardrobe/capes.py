"""What hangs from the shoulders of a warrior: a cape down the back, and a fur collar over its upper edge."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial import cKDTree

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import fabrics, tailoring
from avatarjax.data.wardrobe.bones import limb, nearest_weights, one_bone, share
from avatarjax.data.wardrobe.garments import Piece, grid_faces, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.data.wardrobe.textures import noise
from avatarjax.physics.cloth import Fabric


def cape(
    rig: Rig,
    under: list[Piece],
    *,
    top: float,
    free: float,
    bottom: float,
    half_top: float = 0.175,
    half_bottom: float = 0.36,
    margin: float = 0.024,
    folds: int = 9,
    fabric: Fabric = fabrics.WOOL,
    rows: int = 42,
    columns: int = 52,
) -> Piece:
    """A cape down the back from height `top`, sewn on down to height `free`, to `bottom`, metres, held clear of what is
    `under` it; `half_top` and `half_bottom` are half its widths."""
    heights = np.concatenate([np.linspace(top, free, 5)[:-1], np.linspace(free, bottom, rows - 4)])
    side = np.linspace(-1, 1, columns)
    skin = under[0]
    trunk = skin.vertices[share(rig, skin.weights, "Arm", "Hand") < 0.4]
    points = np.zeros((rows, columns, 3))
    behind = 0.0
    for i, y in enumerate(heights):
        drop = np.array(max(free - y, 0.0) / (free - bottom))
        half = half_top + (half_bottom - half_top) * drop
        slab = trunk[(np.abs(trunk[:, 1] - y) < 0.035)][:, 2]
        behind = min(behind, float(slab.min()) - margin - 0.004) if len(slab) else behind
        points[i, :, 0] = half * side
        points[i, :, 1] = y
        # It lies around the back, and stands off further down.
        points[i, :, 2] = behind - 0.09 * drop + 0.35 * half * side**2 * (1 - 0.6 * drop)
    ground = Ground.of(under)
    flat = points.reshape(-1, 3)
    for _ in range(5):
        flat = ground.hold_clear(flat, margin, rounds=1, deepest=0.09)
        grid = flat.reshape(rows, columns, 3)
        grid[1:-1] = (grid[:-2] + 2 * grid[1:-1] + grid[2:]) / 4
        grid[:, 1:-1] = (grid[:, :-2] + 2 * grid[:, 1:-1] + grid[:, 2:]) / 4
        flat = grid.reshape(-1, 3)
    flat = ground.hold_clear(flat, margin, rounds=2, deepest=0.09)
    # What is pushed out by a hem does not fall back in below it.
    flat[:, 2] = np.minimum.accumulate(flat[:, 2].reshape(rows, columns), axis=0).ravel()
    # Folds add to what was smoothed, and only outwards.
    fold = 0.5 + 0.5 * np.cos(folds * np.pi * side + 0.5 * np.sin(2 * np.pi * side))
    drop = np.clip((free - heights) / (free - bottom), 0, 1)
    flat[:, 2] -= (0.042 * drop[:, None] ** 0.7 * fold).ravel()
    # Rows go down and columns from its right to its left, which seen from behind is counter-clockwise.
    faces, uvs = grid_faces(rows, columns, closed=False)
    faces, uvs = faces[:, [0, 2, 1]], uvs[:, [0, 2, 1]]
    vertices = flat.astype(np.float32)
    fall = np.clip(free - np.repeat(heights, columns), 0, None)
    sewn = smoothstep(fall, 0.15, 0.0)[:, None]
    weights = sewn * nearest_weights(vertices, skin.vertices, skin.weights, 16) + (1 - sewn) * one_bone(
        rig, "Spine2", len(vertices)
    )
    return Piece(
        "cape",
        vertices,
        faces,
        uvs,
        weights.astype(np.float32),
        (1.45 * fall).astype(np.float32),
        fabric=fabric,
        solid=False,
    )


def fur_collar(
    rig: Rig, shell: Piece, *, low: float, front: float = 0.075, sleeve: float = 0.05, thickness: float = 0.05
) -> Piece:
    """Fur about the neck and over the shoulders, from a close shell of the body: behind down to height `low`, metres,
    open in front by `front` to either side, and over the arms as far as `sleeve` past the shoulder joints."""
    p = shell.vertices.astype(np.float64)
    along = limb(rig, "Arm", "ForeArm").along(p)
    neck = rig.heads[rig.index("Neck"), 1]
    # It hangs lower behind than in front, and less far to the sides.
    depth = low + 0.5 * np.clip(p[:, 2] + 0.02, 0, 0.1) + 0.12 * np.abs(p[:, 0])
    throat = np.hypot(p[:, 0], np.minimum(p[:, 2] - 0.02, 0.0)) - 0.052
    levels = [p[:, 1] - depth, sleeve - along, np.maximum(np.abs(p[:, 0]) - front, 0.03 - p[:, 2])]
    levels.append(np.maximum(neck - 0.005 - p[:, 1], throat))
    level = np.min(levels, axis=0)
    piece = tailoring.clip(shell, level)
    piece = tailoring.subdivide(tailoring.let_out(piece, 0.008, smooth=0.6, rounds=6))
    # Its edges are rounded, and thick enough to cover what hangs from below.
    edge = _from_the_edge(piece)
    thick = thickness * (0.35 + 0.65 * smoothstep(edge, 0.0, 0.045))
    return dataclasses.replace(furry(tailoring.spread_uvs(piece), thick), name="fur collar")


def _from_the_edge(piece: Piece) -> np.ndarray:
    """Metres (v,) of each vertex from the nearest open edge of a piece."""
    edges = np.sort(np.concatenate([piece.faces[:, [0, 1]], piece.faces[:, [1, 2]], piece.faces[:, [2, 0]]]), axis=1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    rim = piece.vertices[np.unique(pairs[count == 1])]
    return cKDTree(rim).query(piece.vertices)[0]


def furry(piece: Piece, thickness: np.ndarray | float, *, tuft: float = 0.012, seed: int = 70) -> Piece:
    """The piece let out by `thickness`, () or (v,) metres, into fur whose surface is rough by `tuft` metres."""
    p = piece.vertices.astype(np.float64)
    rough = 0.7 * noise(p * np.array([1, 0.6, 1]), 0.022, seed) + 0.5 * noise(p, 0.05, seed + 1)
    deep = np.clip(np.asarray(thickness) / 0.02, 0, 1)
    return tailoring.let_out(piece, thickness + tuft * rough * deep, smooth=0.25, rounds=2)
