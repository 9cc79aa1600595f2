"""A string of big beads around the neck."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import paths
from avatarjax.data.wardrobe.bones import nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces
from avatarjax.data.wardrobe.ground import Ground


def necklace(
    rig: Rig, lie_on: Ground, *, collar: float, radius: float, depth: float, apart: float = 2.05
) -> Float[np.ndarray, "n 3"]:
    """Places (n, 3) of beads of a radius, metres, on a string around the neck at height `collar` that hangs `depth`
    deep on the chest; neighbours are `apart` radii apart."""
    neck = rig.heads[rig.index("Neck")]
    angles = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    ahead = np.clip(np.cos(angles), 0, 1) ** 0.8
    x = 0.076 * np.sin(angles) * (1 + 0.35 * ahead)
    y = collar - depth * ahead
    z = neck[2] + np.where(np.cos(angles) > 0, 0.03 + 0.1 * np.sqrt(ahead), 0.03 + 0.1 * np.cos(angles))
    string = np.stack([x, y, z], axis=1)
    for _ in range(8):
        # On the chest the string is as far out as the beads are thick, neither floating nor sunk.
        height, normal = lie_on.height(string)
        level = normal * np.array([1.0, 0.15, 1.0])
        string -= level * np.clip(height - radius - 0.003, -0.03, 0.03)[:, None]
        string = (np.roll(string, 1, 0) + 2 * string + np.roll(string, -1, 0)) / 4
    string = lie_on.clear(string, radius + 0.002)
    around = np.linalg.norm(np.roll(string, -1, 0) - string, axis=1).sum()
    # An odd number, so that one bead is lowest.
    count = int(around / (apart * radius)) // 2 * 2 + 1
    return paths.even(string, count, closed=True)


def beads(
    string: Float[np.ndarray, "n 3"],
    body: Float[np.ndarray, "v 3"],
    weights: Float[np.ndarray, "v j"],
    *,
    radius: float = 0.014,
    rows: int = 6,
    columns: int = 8,
) -> Piece:
    """Beads of a radius (metres) at the points of a string (n, 3), each rigid, moving as the body (v, 3) below it.

    v of the uvs runs from pole to pole, u along the string: one bead after the other.
    """
    polar = np.linspace(0.12, np.pi - 0.12, rows)
    angles = np.arange(columns) * 2 * np.pi / columns
    ball = np.stack(
        [np.sin(polar)[:, None] * np.sin(angles), np.cos(polar)[:, None] * np.ones(columns),
         np.sin(polar)[:, None] * np.cos(angles)], axis=-1
    ).reshape(-1, 3)  # fmt: skip
    faces, uvs = grid_faces(rows, columns, closed=True)
    # The poles are closed by fans without a vertex of their own.
    ends, fans = [0, (rows - 1) * columns], []
    for at, turn in zip(ends, (1, -1), strict=True):
        fans += [[at, at + k, at + k + 1][::turn] for k in range(1, columns - 1)]
    caps = np.array(fans, np.int32)
    cap_uvs = np.zeros((len(caps), 3, 2), np.float32)
    cap_uvs[..., 0] = np.array([0.2, 0.5, 0.8])
    cap_uvs[: columns - 2, :, 1] = 1.0
    faces, uvs = np.concatenate([faces, caps]), np.concatenate([uvs, cap_uvs])
    count = len(string)
    vertices = (string[:, None] + radius * ball[None]).reshape(-1, 3).astype(np.float32)
    starts = np.arange(count) * len(ball)
    uvs = np.stack([(uvs + np.array([k, 0])) / np.array([count, 1]) for k in range(count)])
    carried = nearest_weights(string, body, weights, 40).repeat(len(ball), axis=0)
    return Piece(
        "beads",
        vertices,
        (faces[None] + starts[:, None, None]).reshape(-1, 3).astype(np.int32),
        uvs.reshape(-1, 3, 2).astype(np.float32),
        carried,
    )
