"""What is worn on the head: a cowboy hat, a hood that lies on the back, and a veil."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import drape, fabrics, paths
from avatarjax.data.wardrobe.bones import head_then_chest, nearest_weights, one_bone
from avatarjax.data.wardrobe.garments import Piece, grid_faces, outline, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.physics.cloth import Fabric

_UP = np.array([0.0, 1.0, 0.0])


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


def hood(
    rig: Rig,
    lie_on: Ground,
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
    points = drape.settle(np.concatenate([ring[None], points[1:]]), lie_on, 0.01)
    faces, uvs = grid_faces(rows, columns, closed=False)
    gone = paths.walked(points)
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
    lie_on: Ground,
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
    band = lie_on.clear(paths.even(band, columns) + 0.004 * up, 0.006)
    torn = 0.5 * np.sin(turn * 9 + 0.6) + 0.35 * np.sin(turn * 17 + 2.1) + 0.35 * np.sin(turn * 23)
    lengths = length - 0.5 * np.abs(centre[1] + 0.12 - band[:, 1]) + tatter * length * (torn - 0.3)

    def pull(p: np.ndarray, gone: np.ndarray) -> np.ndarray:
        back = 0.5 * np.exp(-gone / 0.06) + 0.02
        # It spreads as it falls, in soft folds.
        side = 0.9 * np.sin(turn) * smoothstep(gone, 0.1, 0.3) * np.exp(-gone / 0.5)
        return np.stack([side * 0.35, -np.ones(columns), -back], axis=1)

    points = drape.fall(band, lengths, rows, lie_on, pull=pull, gap=gap, ease=3, smooth=0.4)
    gone = paths.walked(points)
    fold = 0.022 * smoothstep(gone, 0.25, 0.7) * (0.5 + 0.5 * np.cos(7.2 * turn + 0.8 * np.sin(2.3 * turn)))
    _, normal = lie_on.height(points.reshape(-1, 3))
    level = normal.reshape(points.shape) * np.array([1.0, 0, 1.0])
    points = points + fold[..., None] * level / np.maximum(np.linalg.norm(level, axis=-1, keepdims=True), 0.3)
    for _ in range(2):
        points[3:-1] = (points[2:-2] + 2 * points[3:-1] + points[4:]) / 4
    points = drape.settle(points, lie_on, 0.8 * gap)
    faces, uvs = grid_faces(rows, columns, closed=False)
    faces, uvs = faces[:, ::-1].copy(), uvs[:, ::-1].copy()
    vertices = points.reshape(-1, 3).astype(np.float32)
    # Pinned to the hair for a hand's breadth behind the band.
    reach = 1.3 * np.clip(gone - 0.06, 0, None)
    weights = head_then_chest(rig, vertices)
    return Piece("veil", vertices, faces, uvs, weights, reach.ravel().astype(np.float32), fabric=fabric, solid=False)
