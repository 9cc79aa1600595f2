"""What hangs from the waist: a flared skirt, a long one in folds, a pleated kilt, and the skirt of an open coat."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import fabrics, paths
from avatarjax.data.wardrobe.bones import nearest_weights, one_bone
from avatarjax.data.wardrobe.garments import Piece, grid_faces, outline, smoothstep
from avatarjax.physics.cloth import Fabric


def skirt(
    rig: Rig,
    body: Float[np.ndarray, "v 3"],
    *,
    top: float,
    bottom: float,
    flare: float = 0.32,
    margin: float = 0.012,
    fabric: Fabric = fabrics.DENIM,
    folds: int = 11,
    rows: int = 26,
    columns: int = 66,
) -> Piece:
    """A skirt from height `top` to `bottom` around the body vertices (v, 3) (without arms); its upper rows are sewn on.

    `flare` is the outward slope, `margin` the distance from the skin, both in metres (per metre).
    """
    angles = np.arange(columns) * 2 * np.pi / columns
    heights = np.linspace(top, bottom, rows)
    centre = np.array([0.0, rig.heads[rig.index("Hips"), 2]])
    radius = _widening(body, centre, angles, heights, flare=flare, margin=margin)
    drop = (top - heights) / (top - bottom)
    ripple = 0.018 * drop[:, None] ** 1.5 * np.cos(folds * angles + 0.5 * np.sin(2 * angles))[None]
    radius = radius + ripple
    points = _around(centre, angles, radius, heights)
    vertices = points.reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=True)

    weights = one_bone(rig, "Hips", len(vertices))
    reach = np.repeat(np.clip(drop - 0.08, 0, None), columns) * (top - bottom) * 1.6
    return Piece("skirt", vertices, faces, uvs, weights, reach.astype(np.float32), fabric=fabric, solid=False)


def long_skirt(
    rig: Rig,
    body: Float[np.ndarray, "v 3"],
    *,
    top: float,
    bottom: float,
    flare: float = 0.17,
    depth: float = 0.045,
    folds: int = 13,
    margin: float = 0.012,
    fabric: Fabric = fabrics.WOOL,
    rows: int = 42,
    columns: int = 88,
) -> Piece:
    """A floor-length skirt from height `top` to `bottom` around the body (v, 3) without its arms, sewn on at the top.

    `flare` is the outward slope; `depth` (metres) how deep the `folds` are at the hem, `margin` the gap to the skin.
    """
    angles = np.arange(columns) * 2 * np.pi / columns
    heights = np.linspace(top, bottom, rows)
    centre = np.array([0.0, rig.heads[rig.index("Hips"), 2]])
    # Cloth that hangs from the belt is stretched over the hips, and does not follow a hollow back.
    margins = margin * np.minimum(1.0, 0.3 + 0.35 * np.arange(rows))
    radius = _widening(body, centre, angles, heights, flare=flare, margin=margins)
    for _ in range(3):
        around = (np.roll(radius, 1, 1) + 2 * radius + np.roll(radius, -1, 1)) / 4
        radius = np.maximum(radius, around)
    drop = (top - heights) / (top - bottom)
    # No two folds are alike, but left and right are: they are waves of the angle from the front.
    phase = folds * angles + 0.9 * np.sin(2 * angles) + 0.5 * np.sin(3 * angles)
    wave = 0.5 + 0.5 * np.cos(phase - phase[0]) * (0.8 + 0.2 * np.cos(5 * angles))
    radius = radius + (depth * drop**0.9 + 0.006 * smoothstep(drop, 0.0, 0.04))[:, None] * wave[None]
    points = _around(centre, angles, radius, heights)
    faces, uvs = grid_faces(rows, columns, closed=True)
    down = paths.walked(points)
    reach = 1.3 * np.clip(down - down[1], 0, None)
    vertices = points.reshape(-1, 3).astype(np.float32)
    weights = one_bone(rig, "Hips", len(vertices))
    return Piece("skirt", vertices, faces, uvs, weights, reach.ravel().astype(np.float32), fabric=fabric, solid=False)


def kilt(
    rig: Rig,
    body: Float[np.ndarray, "v 3"],
    *,
    top: float,
    bottom: float,
    pleats: int = 22,
    apron: float = 0.75,
    flare: float = 0.2,
    margin: float = 0.012,
    fabric: Fabric = fabrics.WOOL,
    rows: int = 24,
    columns: int = 110,
) -> Piece:
    """A kilt from height `top` to `bottom`, metres, around the body vertices (v, 3) (without arms): flat in front over
    `apron` radians to either side, with `pleats` around the rest; its upper rows are sewn on."""
    angles = np.arange(columns) * 2 * np.pi / columns
    heights = np.linspace(top, bottom, rows)
    centre = np.array([0.0, rig.heads[rig.index("Hips"), 2] + 0.01])
    radius = _widening(body, centre, angles, heights, flare=flare, margin=margin)
    drop = (top - heights) / (top - bottom)
    behind = np.clip((angles - apron) / (2 * np.pi - 2 * apron), 0, 1)
    pleated = smoothstep(np.abs(angles - np.pi), np.pi - apron, np.pi - apron - 0.25)
    wave = 0.5 - 0.5 * np.cos(2 * np.pi * pleats * behind)
    radius += 0.02 * drop[:, None] ** 0.8 * (wave * pleated)[None]
    points = _around(centre, angles, radius, heights)
    vertices = points.reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=True)
    reach = np.repeat(np.clip(drop - 0.12, 0, None), columns) * (top - bottom) * 1.5
    weights = one_bone(rig, "Hips", len(vertices))
    return Piece("kilt", vertices, faces, uvs, weights, reach.astype(np.float32), fabric=fabric, solid=False)


def coat_skirt(
    rig: Rig,
    under: Float[np.ndarray, "v 3"],
    top: Piece,
    *,
    start: float,
    waist: float,
    bottom: float,
    gap: float = 0.48,
    flare: float = 0.19,
    margin: float = 0.012,
    folds: int = 11,
    fabric: Fabric = fabrics.DENIM,
    rows: int = 30,
    columns: int = 84,
) -> Piece:
    """The skirt of an open coat around the body and legs `under` it (v, 3), from height `start` to `bottom`, metres.

    It overlaps the coat's `top` down to `waist` and is sewn there. `gap` is half the open angle in front, radians;
    `flare` metres outwards a metre; `margin` metres from what is under it.
    """
    angles = np.linspace(gap, 2 * np.pi - gap, columns)
    heights = np.concatenate([np.linspace(start, waist, 3)[:-1], np.linspace(waist, bottom, rows - 2)])
    centre = np.array([0.0, rig.heads[rig.index("Hips"), 2] + 0.012])
    even = heights > waist - 0.08
    radius = _widening(under, centre, angles, heights, flare=flare, margin=margin, even=even)
    drop = np.clip((waist - heights) / (waist - bottom), 0, 1)
    phase = folds * (angles - np.pi) + 0.6 * np.sin(2 * angles)
    radius += 0.03 * drop[:, None] ** 1.3 * (np.cos(phase) + 1 - drop[:, None])[:, :]
    # It hangs further out behind, as a coat does that is cut to flare.
    radius *= 1 + 0.1 * drop[:, None] * np.clip(-np.cos(angles), 0, None) ** 2
    # The front edges do not swing inwards over each other.
    points = _around(centre, angles, radius, heights)
    points[..., 1] -= 0.012 * drop[:, None] * np.cos(angles)[None]
    vertices = points.reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=False)
    sewn = np.repeat(smoothstep(drop, 0.15, 0.0), columns)[:, None]
    weights = sewn * nearest_weights(vertices, top.vertices, top.weights) + (1 - sewn) * one_bone(
        rig, "Hips", len(vertices)
    )
    fall = np.clip(waist - 0.015 - np.repeat(heights, columns), 0, None)
    return Piece(
        "coat skirt",
        vertices,
        faces,
        uvs,
        weights.astype(np.float32),
        (1.5 * fall).astype(np.float32),
        fabric=fabric,
        solid=False,
    )


def _widening(
    body: np.ndarray,
    centre: np.ndarray,
    angles: np.ndarray,
    heights: np.ndarray,
    *,
    flare: float,
    margin: np.ndarray | float,
    even: np.ndarray | None = None,
) -> np.ndarray:
    """Radii (rows, columns) at falling heights (rows,) that nowhere narrow downwards: at least `margin`, () or (rows,),
    outside the outline of the body (v, 3) there, and `flare` metres a metre wider than the row above. Rows that are
    `even` (rows,) are smoothed."""
    margins = np.broadcast_to(margin, heights.shape)
    radius = np.zeros((len(heights), len(angles)))
    for i, y in enumerate(heights):
        slab = body[np.abs(body[:, 1] - y) < 0.03][:, [0, 2]]
        fitted = outline(slab, centre, angles) + margins[i]
        radius[i] = np.maximum(fitted, radius[i - 1] + flare * (heights[i - 1] - y)) if i else fitted
        if even is not None and even[i]:
            radius[i, 1:-1] = (radius[i, :-2] + 2 * radius[i, 1:-1] + radius[i, 2:]) / 4
    return radius


def _around(centre: np.ndarray, angles: np.ndarray, radius: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Points (rows, columns, 3) at angles (columns,) and radii (rows, columns) around an upright axis (2,)."""
    outward = np.stack([np.sin(angles), np.zeros(len(angles)), np.cos(angles)], axis=1)
    points = outward[None] * radius[..., None] + np.array([centre[0], 0, centre[1]])
    points[..., 1] = heights[:, None]
    return points
