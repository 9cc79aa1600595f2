"""What hangs from head and shoulders: a hood that lies on the back, a veil, and long hair to both sides of a face."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import drape, fabrics
from avatarjax.data.wardrobe.accessories import nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces, one_bone, smoothstep
from avatarjax.physics.cloth import Fabric

_UP = np.array([0.0, 1.0, 0.0])


def hood(
    rig: Rig,
    lie_on: drape.Ground,
    weights: Float[np.ndarray, "v j"],
    *,
    collar: float,
    stand: float = 0.04,
    length: float = 0.3,
    spread: float = 1.95,
    fabric: Fabric = fabrics.WOOL,
    rows: int = 22,
    columns: int = 40,
) -> Piece:
    """A hood that is down: from the collar at height `collar` it stands up around the neck, rolls over and falls to a
    point on the back.

    `stand` is how far it rises, `length` (metres) how far it falls at the back; `spread` the angle from the back to
    its front ends, radians. It lies on a ground whose points (v, 3) have skinning weights (v, j).
    """
    turn = np.linspace(-spread, spread, columns)
    angles = np.pi + turn
    neck = rig.heads[rig.index("Neck")]
    centre = np.array([0.0, collar, float(neck[2]) + 0.012])
    out = np.stack([np.sin(angles), np.zeros(columns), np.cos(angles)], axis=1)
    # The collar is where level rays from the neck's axis meet the dressed body, lower in front.
    front = smoothstep(np.abs(turn), 1.2, spread)
    ring = centre + out * 0.055 - 0.02 * front[:, None] * _UP
    for _ in range(6):
        height, _ = lie_on.height(ring)
        ring -= out * np.clip(height - 0.003, -0.02, 0.02)[:, None]
    fade = 1 - 0.5 * front
    # Up around the neck and over, an arch in the plane of the ray.
    share = np.linspace(0, 1, 9)[:, None, None]
    arch = np.sin(np.pi * 0.62 * share) / np.sin(np.pi * 0.5)
    rise = ring[None] + arch * (stand * fade)[None, :, None] * _UP
    behind = np.exp(-((turn / 0.62) ** 2))
    roll = (0.014 + (0.03 + 0.04 * behind[None, :, None]) * share**1.6) * share**0.7
    rise = rise + roll * fade[None, :, None] * out[None]
    for i in range(1, 9):
        rise[i] = lie_on.clear(rise[i], 0.012 * min(1.0, i / 3))
    lengths = length * (0.22 * fade + 0.1 + 0.68 * behind)

    def pull(p: np.ndarray, gone: np.ndarray) -> np.ndarray:
        # A hood hangs to a point: its sides are drawn in to the middle of the back.
        inward = -p[:, :1] * np.array([1.0, 0, 0]) * (1.2 * behind * smoothstep(gone, 0.02, 0.2))[:, None]
        away = out * ((0.2 + 0.35 * behind) * np.exp(-gone / 0.04) + 0.05)[:, None]
        return away - _UP + inward

    below = drape.fall(rise[-1], lengths, rows - 8, lie_on, pull=pull, gap=0.013, ease=1, smooth=0.35)
    points = np.concatenate([rise, below[1:]])
    # It is puffed up where the head would be.
    down = np.linspace(0, 1, rows)[:, None]
    puff = 0.03 * np.exp(-(((down - 0.55) / 0.2) ** 2)) * behind[None] ** 0.6
    _, normal = lie_on.height(points.reshape(-1, 3))
    points = points + puff[..., None] * normal.reshape(points.shape)
    for _ in range(3):
        points[2:-1] = (points[1:-2] + 2 * points[2:-1] + points[3:]) / 4
    points = _tidy(np.concatenate([ring[None], points[1:]]), lie_on, 0.01)
    faces, uvs = grid_faces(rows, columns, closed=False)
    gone = drape.walked(points)
    reach = 1.3 * np.clip(gone - gone[2], 0, None)
    reach[:3] = 0
    vertices = points.reshape(-1, 3).astype(np.float32)
    # The roll keeps its bulge: across it, the rising side is tied to the falling one.
    index = np.arange(rows * columns).reshape(rows, columns)
    braces = np.concatenate([np.stack([index[a, 4:-4], index[b, 4:-4]], 1) for a, b in ((2, 9), (3, 8), (3, 11))])
    carried = nearest_weights(vertices, lie_on.points, weights)
    return Piece("hood", vertices, faces, uvs, carried, reach.ravel().astype(np.float32), braces, fabric, False)


def veil(
    rig: Rig,
    lie_on: drape.Ground,
    centre: Float[np.ndarray, "3"],
    *,
    length: float,
    tilt: float = 0.2,
    spread: float = 1.45,
    gap: float = 0.014,
    tatter: float = 0.05,
    fabric: Fabric = fabrics.SILK,
    rows: int = 52,
    columns: int = 48,
) -> Piece:
    """A veil from a band over the head (around `centre`, metres) that falls over the back.

    The band runs from side to side, `tilt` radians behind the top, to `spread` radians from it on either side;
    `length` is measured from the top, metres; its hem is torn by about `tatter` of the length.
    """
    turn = np.linspace(-spread, spread, columns)
    up = np.stack([np.sin(turn), np.cos(turn) * np.cos(tilt), -np.cos(turn) * np.sin(tilt)], axis=1)
    band = drape.outward(lie_on.points[lie_on.points[:, 1] > centre[1] - 0.1], centre, up)
    band = lie_on.clear(drape.even(band, columns) + 0.004 * up, 0.006)
    torn = 0.5 * np.sin(turn * 9 + 0.6) + 0.35 * np.sin(turn * 17 + 2.1) + 0.35 * np.sin(turn * 23)
    lengths = length - 0.5 * np.abs(centre[1] + 0.12 - band[:, 1]) + tatter * length * (torn - 0.3)

    def pull(p: np.ndarray, gone: np.ndarray) -> np.ndarray:
        back = 0.5 * np.exp(-gone / 0.06) + 0.02
        # It spreads as it falls, in soft folds.
        side = 0.9 * np.sin(turn) * smoothstep(gone, 0.1, 0.3) * np.exp(-gone / 0.5)
        return np.stack([side * 0.35, -np.ones(columns), -back], axis=1)

    points = drape.fall(band, lengths, rows, lie_on, pull=pull, gap=gap, ease=3, smooth=0.4)
    gone = drape.walked(points)
    fold = 0.022 * smoothstep(gone, 0.25, 0.7) * (0.5 + 0.5 * np.cos(7.2 * turn + 0.8 * np.sin(2.3 * turn)))
    _, normal = lie_on.height(points.reshape(-1, 3))
    level = normal.reshape(points.shape) * np.array([1.0, 0, 1.0])
    points = points + fold[..., None] * level / np.maximum(np.linalg.norm(level, axis=-1, keepdims=True), 0.3)
    for _ in range(2):
        points[3:-1] = (points[2:-2] + 2 * points[3:-1] + points[4:]) / 4
    points = _tidy(points, lie_on, 0.8 * gap)
    faces, uvs = grid_faces(rows, columns, closed=False)
    faces, uvs = faces[:, ::-1].copy(), uvs[:, ::-1].copy()
    vertices = points.reshape(-1, 3).astype(np.float32)
    # Pinned to the hair for a hand's breadth behind the band.
    reach = 1.3 * np.clip(gone - 0.06, 0, None)
    weights = _head_then_chest(rig, vertices)
    return Piece("veil", vertices, faces, uvs, weights, reach.ravel().astype(np.float32), fabric=fabric, solid=False)


def front_hair(
    rig: Rig,
    side: str,
    lie_on: drape.Ground,
    centre: Float[np.ndarray, "3"],
    *,
    length: float,
    hairline: float,
    crown: float,
    temple: float,
    gap: float = 0.012,
    fabric: Fabric = fabrics.HAIR,
    rows: int = 40,
    columns: int = 18,
) -> Piece:
    """Long hair on one side (Left or Right) of a parting in the middle of the head (around `centre`), which falls to
    the front of the shoulder.

    The parting runs from `hairline` to `crown`, radians from straight ahead over the top; the hair keeps `temple`
    metres from the middle of the face; it is `length` metres long.
    """
    sign = 1.0 if side == "Left" else -1.0
    share = np.linspace(0, 1, columns)
    turn = hairline + (crown - hairline) * share
    up = np.stack([np.full(columns, 0.012 * sign), np.sin(turn), np.cos(turn)], axis=1)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    head = lie_on.points[lie_on.points[:, 1] > centre[1] - 0.1]
    roots = lie_on.clear(drape.even(drape.outward(head, centre, up), columns), 0.006)

    def pull(p: np.ndarray, gone: np.ndarray) -> np.ndarray:
        x = p[:, 0] * sign
        # Combed away from the parting, then down; in front of the shoulder.
        edge = temple + 0.035 * share
        aside = 1.7 * smoothstep(edge - x, -0.01, 0.03) * (gone < 0.25)
        ahead = 0.75 * smoothstep(gone, 0.14, 0.24) * smoothstep(gone, 0.42, 0.3) * smoothstep(p[:, 2], 0.13, 0.05)
        inward = -0.3 * smoothstep(gone, 0.2, 0.3) * smoothstep(x - temple - 0.085 * share, 0.0, 0.05)
        return np.stack([(aside + inward) * sign, -np.ones(columns), ahead], axis=1)

    ragged = 1 + 0.03 * np.sin(share * 12) + 0.015 * np.sin(share * 19 + 1)
    # The way over the crown is longer than that from the forehead.
    lengths = length * ragged + 1.2 * (roots[:, 1] - roots[0, 1]) + 0.05 * share
    points = drape.fall(roots, lengths, rows, lie_on, pull=pull, gap=gap, ease=3, smooth=0.3)
    for _ in range(2):
        points[3:-1] = (points[2:-2] + 2 * points[3:-1] + points[4:]) / 4
    points = _tidy(points, lie_on, 0.8 * gap)
    gone = drape.walked(points)
    faces, uvs = grid_faces(rows, columns, closed=False)
    if side == "Right":
        faces, uvs = faces[:, ::-1].copy(), uvs[:, ::-1].copy()
    vertices = points.reshape(-1, 3).astype(np.float32)
    # On the head it is combed down; what hangs is free.
    reach = 1.3 * np.clip(gone - 0.15, 0, None)
    weights = _head_then_chest(rig, vertices)
    name = side.lower() + " hair"
    return Piece(name, vertices, faces, uvs, weights, reach.ravel().astype(np.float32), fabric=fabric, solid=False)


def _tidy(points: np.ndarray, lie_on: drape.Ground, gap: float) -> np.ndarray:
    """The sheet (r, n, 3) evenly meshed and, from its fourth row on, `gap` clear of the ground."""
    gaps = np.repeat(gap * np.minimum(np.arange(len(points)) / 3, 1.0), points.shape[1])
    for _ in range(3):
        points = lie_on.clear(points.reshape(-1, 3), gaps).reshape(points.shape)
        points = drape.even_grid(points, rounds=1)
    return points


def _head_then_chest(rig: Rig, vertices: np.ndarray) -> np.ndarray:
    """Weights (v, j) on the head, blending to the chest below the chin."""
    neck = rig.heads[rig.index("Neck"), 1]
    on_head = smoothstep(vertices[:, 1], neck - 0.06, neck + 0.06)
    weights = one_bone(rig, "Head", len(vertices)) * on_head[:, None]
    weights[:, rig.index("Spine2")] += 1 - on_head
    return weights.astype(np.float32)
