"""Boots, each one sheet from the calf to the toes, and sandals, a sole with two bands."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe.bones import nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces, outline

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


def sandal(
    rig: Rig,
    side: str,
    body: Float[np.ndarray, "v 3"],
    weights: Float[np.ndarray, "v j"],
    *,
    thickness: float = 0.014,
    margin: float = 0.005,
    columns: int = 24,
) -> Piece:
    """A sandal (`side` is Left or Right) on the foot of the body (v, 3), whose sole is `thickness` metres below y = 0.

    v of its uvs is above 0.5 on the bands and below on the sole.
    """
    ankle = rig.heads[rig.index(side + "Foot")].astype(np.float64)
    toe = rig.tails[rig.index(side + "ToeBase")]
    ahead = (toe - ankle) * np.array([1, 0, 1])
    ahead /= np.linalg.norm(ahead)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    angles = np.arange(columns) * 2 * np.pi / columns
    foot = body[(np.abs(body[:, 0] - ankle[0]) < 0.11) & (body[:, 1] < 0.11)]
    print_ = foot[foot[:, 1] < 0.025]
    flat = np.stack([(print_ - ankle) @ right, (print_ - ankle) @ ahead], axis=1)
    middle = (flat.min(0) + flat.max(0)) / 2
    edge = outline(flat, middle, angles) + margin
    centre = (ankle + middle[0] * right + middle[1] * ahead) * np.array([1, 0, 1])
    around = np.sin(angles)[:, None] * right + np.cos(angles)[:, None] * ahead
    sole = []
    for size, y in ((0.02, 0.001), (0.55, 0.001), (1.0, 0.001), (1.02, -0.4 * thickness), (0.99, -thickness)):
        sole.append(centre + around * (edge * size)[:, None] + np.array([0, y, 0]))
    sole.append(centre + around * (edge * 0.02)[:, None] - np.array([0, thickness, 0]))
    points, face_lists, uv_lists, count = [np.concatenate(sole)], [], [], len(sole) * columns
    faces, uvs = grid_faces(len(sole), columns, closed=True)
    face_lists.append(faces)
    uv_lists.append(uvs * np.array([1, 0.48]))
    # A band over the toes' roots and one over the instep; both end in the sole.
    for at in (0.135, 0.055):
        near = np.abs((foot - ankle) @ ahead - at) < 0.016
        slab = np.stack([(foot[near] - ankle) @ right, foot[near][:, 1]], axis=1)
        mid = (slab.min(0) + slab.max(0)) / 2
        ring = outline(slab, mid, angles) + 0.8 * margin
        lean = 0.25 if at < 0.1 else 0.1
        rows = []
        for offset, raise_ in ((-0.0125, -0.003), (-0.0115, 0.001), (0.0, 0.0015), (0.0115, 0.001), (0.0125, -0.003)):
            out = (ring + raise_)[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=1) + mid
            # The instep slopes: the band stands square on it.
            back = at + offset - lean * (out[:, 1] - mid[1])
            row = (ankle * np.array([1, 0, 1])) + out[:, :1] * right + back[:, None] * ahead
            row[:, 1] = np.maximum(out[:, 1] - lean * offset, -0.5 * thickness)
            rows.append(row)
        faces, uvs = grid_faces(len(rows), columns, closed=True)
        points.append(np.concatenate(rows))
        face_lists.append(faces + count)
        low = 0.52 if at > 0.1 else 0.77
        uv_lists.append(uvs * np.array([1, 0.22]) + np.array([0, low]))
        count += len(rows) * columns
    vertices = np.concatenate(points).astype(np.float32)
    return Piece(
        side.lower() + " sandal",
        vertices,
        np.concatenate(face_lists).astype(np.int32),
        np.concatenate(uv_lists).astype(np.float32),
        nearest_weights(vertices, body, weights),
    )
