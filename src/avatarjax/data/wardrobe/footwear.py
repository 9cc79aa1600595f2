"""Sandals: a sole under the foot and two bands across it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe.accessories import nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces, outline


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
