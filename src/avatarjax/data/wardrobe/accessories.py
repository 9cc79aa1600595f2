"""What an avatar wears beside cloth: boots, a hat and long hair, each a sheet grown around the shaped body."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import fabrics
from avatarjax.data.wardrobe.garments import Piece, grid_faces, one_bone, outline, smoothstep

_DOWN = np.array([0.0, -1.0, 0.0])


def boot(
    rig: Rig,
    side: str,
    body: Float[np.ndarray, "v 3"],
    weights: Float[np.ndarray, "v j"],
    *,
    top: float,
    margin: float = 0.007,
    columns: int = 22,
) -> Piece:
    """A boot (`side` is Left or Right) from height `top` over one leg of the body (v, 3), in one sheet.

    Its rings are level down to the ankle, fan about the instep around the heel, and walk upright to the toes. Each
    ring is the convex outline of the leg in its plane, `margin` metres outside the skin.
    """
    ankle = rig.heads[rig.index(side + "Foot")].astype(np.float64)
    toe = rig.tails[rig.index(side + "ToeBase")]
    along = (toe - ankle) * np.array([1, 0, 1])
    along = along / np.linalg.norm(along)
    lateral = np.cross([0.0, 1.0, 0.0], along)
    leg = body[(np.abs(body[:, 0] - ankle[0]) < 0.12) & (body[:, 1] < top + 0.04)]
    pivot = ankle + 0.062 * along + np.array([0, 0.035, 0])
    reach = ((leg - pivot) @ along)[leg[:, 1] < 0.05].max() + margin + 0.012

    planes = [(np.array([pivot[0], y, pivot[2]]), -along) for y in np.linspace(top, pivot[1], 9)[:-1]]
    for angle in np.linspace(0, np.pi / 2, 9)[:-1]:
        planes.append((pivot, -along * np.cos(angle) + _DOWN * np.sin(angle)))
    planes += [(pivot + along * s, _DOWN) for s in reach * np.array([0, 0.15, 0.3, 0.45, 0.6, 0.72, 0.82, 0.91])]
    angles = np.arange(columns) * 2 * np.pi / columns
    centres, radii, last = [], [], 0.0
    for i, (origin, deep) in enumerate(planes):
        offset = leg - origin
        # Rows of vertices are 2 cm apart on the calf, closer on the foot.
        near = np.abs(offset @ np.cross(lateral, deep)) < (0.03 if i < 8 else 0.014)
        if origin is pivot:
            near &= offset @ deep > 0
        flat = np.stack([offset[near] @ lateral, offset[near] @ deep], axis=1)
        centre = (flat.min(0) + flat.max(0)) / 2
        centres.append(origin + centre[0] * lateral + centre[1] * deep)
        radii.append(outline(flat, centre, angles) + margin)
    radii = np.array(radii)
    for _ in range(2):
        radii[1:-1] = (radii[:-2] + 2 * radii[1:-1] + radii[2:]) / 4
    # The shaft widens towards its top, and the toe is closed by two small rings.
    radii[:6] += 0.014 * np.linspace(1, 0, 6)[:, None] ** 2
    rings = []
    for (_, deep), centre, radius in zip(planes, centres, radii, strict=True):
        rings.append(centre + radius[:, None] * (np.sin(angles)[:, None] * lateral + np.cos(angles)[:, None] * deep))
    for share, size in ((0.97, 0.6), (1.0, 0.02)):
        last = centres[-1] + (pivot + along * reach * share - centres[-1]) @ along * along
        rings.append(last + (rings[len(planes) - 1] - centres[-1]) * size + _DOWN * 0.006 * (1 - size))
    points = np.stack(rings)
    points[..., 1] = np.maximum(points[..., 1], -0.012)
    faces, uvs = grid_faces(len(rings), columns, closed=True)
    vertices = points.reshape(-1, 3).astype(np.float32)
    # Columns run from behind to the side, so the other way round than the grid takes them to.
    return Piece(
        side.lower() + " boot",
        vertices,
        faces[:, [0, 2, 1]],
        uvs[:, [0, 2, 1]],
        nearest_weights(vertices, body, weights),
    )


def nearest_weights(
    points: Float[np.ndarray, "n 3"], body: Float[np.ndarray, "v 3"], weights: Float[np.ndarray, "v j"], count: int = 12
) -> Float[np.ndarray, "n j"]:
    """Skinning weights (n, j) of points near a body: means of its nearest vertices' weights."""
    _, nearest = cKDTree(body).query(points, k=count)
    mean = weights[nearest].mean(axis=1)
    return (mean / mean.sum(1, keepdims=True)).astype(np.float32)


def hat(rig: Rig, head: Float[np.ndarray, "v 3"], *, base: float, brim: float = 0.085, columns: int = 48) -> Piece:
    """A cowboy hat on the vertices (v, 3) of a head with its hair, whose band sits at height `base`; rigid on the head.

    `brim` is the width of the brim, metres. u of its uvs runs around, v goes from 0 at the tip to 1 at the brim's edge.
    """
    angles = np.arange(columns) * 2 * np.pi / columns
    slab = head[np.abs(head[:, 1] - base) < 0.02][:, [0, 2]]
    centre = (slab.min(0) + slab.max(0)) / 2
    fit = outline(slab, centre, angles) + 0.008
    fit = (fit + np.roll(fit, 1) + np.roll(fit, -1)) / 3
    aside = np.sin(angles) ** 2
    rows = []
    for share in (1.0, 0.98, 0.8, 0.55, 0.3, 0.1, 0.0):
        curl = 0.05 * aside * share**2.5 - 0.022 * (1 - aside) * share**1.5
        rows.append((fit + brim * share, curl + (0.004 if share == 0.98 else 0.0)))
    for rise, taper in (
        (0.02, 1.0),
        (0.05, 0.97),
        (0.08, 0.93),
        (0.1, 0.9),
        (0.116, 0.83),
        (0.124, 0.7),
        (0.126, 0.45),
    ):
        rows.append((fit * taper, np.full(columns, rise)))
    rows.append((fit * 0.02, np.full(columns, 0.126)))
    points = np.zeros((len(rows), columns, 3))
    for i, (radius, rise) in enumerate(rows):
        points[i, :, 0] = centre[0] + radius * np.sin(angles)
        points[i, :, 2] = centre[1] + radius * np.cos(angles)
        points[i, :, 1] = base + rise
        # A crease along the top and two dents at its front, as one pinches it.
        inner = smoothstep(rise, 0.09, 0.124)
        across, ahead = points[i, :, 0] - centre[0], points[i, :, 2] - centre[1]
        points[i, :, 1] -= inner * 0.035 * np.exp(-((across / 0.028) ** 2))
        points[i, :, 1] += inner * 0.012 * ahead / 0.08
        points[i, :, 0] -= smoothstep(rise, 0.02, 0.1) * 0.22 * across * smoothstep(ahead, 0.0, 0.09)
    points[..., 1] += 0.1 * (points[..., 2] - centre[1])
    faces, uvs = grid_faces(len(rows), columns, closed=True)
    vertices = points.reshape(-1, 3).astype(np.float32)
    weights = one_bone(rig, "Head", len(vertices))
    return Piece("hat", vertices, faces, uvs, weights)


def long_hair(
    rig: Rig,
    body: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    head: Float[np.ndarray, "h 3"],
    *,
    top: float,
    ear: float,
    bottom: float,
    spread: float = 1.98,
    margin: float = 0.014,
    columns: int = 56,
) -> Piece:
    """Hair that falls from the head (h, 3) over the back of the body (v, 3).

    From height `top` to `ear` it follows the outline of the head, below it hangs, pushed out of the body, to `bottom`
    at the back. `spread` is the angle from the back to the front edges, radians.
    """
    turn = np.linspace(-spread, spread, columns)
    heights = np.linspace(top, ear, 9)
    middle = head[np.abs(head[:, 1] - top) < 0.03][:, [0, 2]]
    centre = (middle.min(0) + middle.max(0)) / 2
    strands = 0.004 * np.sin(turn * 23) + 0.003 * np.sin(turn * 41 + 1)
    rows, reach = [], np.zeros(columns)
    for y in heights:
        # The edges start at the temples and run back to the ears.
        angles = np.pi + turn * (1 + 0.1 * (y - ear) / (top - ear))
        slab = head[np.abs(head[:, 1] - y) < 0.02][:, [0, 2]]
        reach = np.maximum(outline(slab, centre, angles) + margin, reach * 0.995)
        at = centre + np.stack([np.sin(angles), np.cos(angles)], axis=1) * (reach + strands)[:, None]
        rows.append(np.stack([at[:, 0], np.full(columns, y), at[:, 1]], axis=1))
    # The upper edge is tucked under the hat.
    axis = np.array([centre[0], 0.0, centre[1]])
    rows.insert(0, axis + (rows[0] - axis) * np.array([0.7, 1.0, 0.7]) + np.array([0, 0.025, 0]))
    tree = cKDTree(body)
    # The front edges are shorter, and no two strands end at the same height.
    front = smoothstep(np.abs(turn), 1.1, spread)
    length = (ear - bottom) * (1 - 0.12 * front) * (1 + 0.05 * np.sin(turn * 9) + 0.04 * np.sin(turn * 17 + 2))
    count = 20
    for i in range(count):
        point = rows[-1].copy()
        point[:, 1] -= length / count
        # Below the ears the hair is swept back, so that it falls behind the shoulders.
        back = -turn * 0.09 * (i < 7)
        x, z = point[:, 0] - centre[0], point[:, 2] - centre[1]
        point[:, 0] = centre[0] + x * np.cos(back) + z * np.sin(back)
        point[:, 2] = centre[1] - x * np.sin(back) + z * np.cos(back)
        point[:, 0] *= 0.985
        for _ in range(4):
            _, nearest = tree.query(point, k=4)
            normal = normals[nearest].mean(1)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            depth = ((point - body[nearest].mean(1)) * normal).sum(1)
            push = np.clip(margin + 0.02 * i / count - depth, 0, 0.05) * (depth > -0.12)
            # On the shoulders too it slides off to the back.
            away = np.stack([normal[:, 0], 0.3 * normal[:, 1], -np.abs(normal[:, 2]) - 0.3], axis=1)
            point += away * push[:, None]
        point[1:-1] = (point[:-2] + 2 * point[1:-1] + point[2:]) / 4
        rows.append(point)
    vertices = np.concatenate(rows).astype(np.float32)
    faces, uvs = grid_faces(len(rows), columns, closed=False)
    weights = one_bone(rig, "Head", len(vertices))
    fall = np.clip((ear - vertices[:, 1]) / (ear - bottom), 0, 1)
    reach = (1.6 * (ear - bottom) * np.clip(fall - 0.03, 0, None)).astype(np.float32)
    return Piece("hair", vertices, faces, uvs, weights, reach, fabric=fabrics.HAIR, solid=False)
