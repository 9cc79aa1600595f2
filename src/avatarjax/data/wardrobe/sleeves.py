"""Wide sleeves that hang from the arms."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import fabrics, paths
from avatarjax.data.wardrobe.bones import nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces, outline, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.physics.cloth import Fabric


def sleeve_bell(
    rig: Rig,
    side: str,
    lie_on: Ground,
    weights: Float[np.ndarray, "v j"],
    *,
    start: float,
    past_wrist: float = 0.02,
    width: float = 0.03,
    drop: float = 0.16,
    margin: float = 0.011,
    fabric: Fabric = fabrics.WOOL,
    rows: int = 26,
    columns: int = 40,
) -> Piece:
    """A wide sleeve (`side` is Left or Right) around the arm of a dressed body, one tube sewn on at its upper end.

    It begins `start` metres below the shoulder joint and ends `past_wrist` metres after the wrist, where it is `width`
    metres wider than the arm and hangs `drop` metres below it. Its weights come from
    the body's (v, j), whose points are the ground.
    """
    # The right sleeve is made as a left one on the mirrored body.
    mirror = np.array([1.0 if side == "Left" else -1.0, 1, 1])
    joints = [rig.heads[rig.index(side + n)] * mirror for n in ("Arm", "ForeArm", "Hand")]
    joints.append(rig.tails[rig.index(side + "Hand")] * mirror)
    path = paths.even(np.stack(joints), 400)
    # An elbow is rounder in a sleeve than in the skeleton.
    along = paths.walked(path)
    kernel = np.hanning(141) / np.hanning(141).sum()
    tangents = np.gradient(path, axis=0)
    padded = np.pad(tangents, ((70, 70), (0, 0)), mode="edge")
    tangents = np.stack([np.convolve(padded[:, k], kernel, "valid") for k in range(3)], axis=1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    wrist = np.linalg.norm(np.diff(np.stack(joints[:3]), axis=0), axis=1).sum()

    arms = [rig.index(n) for n in rig.names if n.startswith(side) and ("Arm" in n or "Hand" in n)]
    on_arm = weights[:, arms].sum(1) > 0.6
    arm = lie_on.points[on_arm] * mirror
    # Fingers look every way, and the sleeve ends before them.
    fingers = [rig.index(n) for n in rig.names if n.startswith(side + "Hand") and n != side + "Hand"]
    palm = weights[:, fingers].sum(1) < 0.3
    clear_of = Ground.at((lie_on.points[palm], lie_on.normals[palm]))
    angles = np.arange(columns) * 2 * np.pi / columns
    rings = []
    shares = np.linspace(0, 1, rows)
    gaps = 0.002 + (margin - 0.002) * smoothstep(shares, 0.0, 0.12)
    for share, gap in zip(shares, gaps, strict=True):
        s = start + share * (wrist + past_wrist - start)
        centre = np.array([np.interp(s, along, path[:, k]) for k in range(3)])
        axis = np.array([np.interp(s, along, tangents[:, k]) for k in range(3)])
        axis /= np.linalg.norm(axis)
        # Down and a little back, so that it is behind the arm when the arm is lowered.
        hang = np.array([0.0, -0.8, -0.6])
        hang -= (hang @ axis) * axis
        hang /= np.linalg.norm(hang)
        across = np.cross(axis, hang)
        offset = arm - centre
        near = np.abs(offset @ axis) < 0.022
        flat = np.stack([offset[near] @ across, offset[near] @ hang], axis=1)
        flat = flat[np.linalg.norm(flat, axis=1) < 0.13]
        fitted = outline(flat, np.zeros(2), angles) + gap
        wide = fitted * np.sin(angles) * (1 + width * share / 0.06 * (1 + 0.5 * np.cos(angles)))
        low = fitted * np.cos(angles) + drop * share**1.4 * smoothstep(np.cos(angles), -0.6, 0.9)
        ring = centre + wide[:, None] * across + low[:, None] * hang
        rings.append(paths.even(ring, columns, closed=True))
    points = np.stack(rings)
    for _ in range(2):
        points[2:-1] = (points[1:-2] + 2 * points[2:-1] + points[3:]) / 4
    points = points * mirror
    # Its end is sewn into the cloth below, so that no edge stands off.
    for i, sunk in ((0, -0.002), (1, 0.0015)):
        for _ in range(4):
            height, normal = lie_on.height(points[i])
            points[i] -= normal * np.clip(height - sunk, -0.01, 0.01)[:, None]
    for i in range(2, rows):
        if i < 8:
            # From there it rises from the arm little by little.
            height, normal = clear_of.height(points[i])
            points[i] -= normal * np.clip(height - 0.004 * i, 0, 0.03)[:, None]
        points[i] = clear_of.clear(points[i], 0.75 * margin * min(1.0, (i + 2) / 7))
        points[i] = paths.even(points[i], columns, closed=True)
    faces, uvs = grid_faces(rows, columns, closed=True)
    if side == "Left":
        faces, uvs = faces[:, ::-1].copy(), uvs[:, ::-1].copy()
    points[1:] = np.stack([paths.even(column, rows - 1) for column in points[1:].transpose(1, 0, 2)], axis=1)
    down = paths.walked(points)
    reach = 1.3 * np.clip(down - down[1], 0, None)
    vertices = points.reshape(-1, 3).astype(np.float32)
    carried = nearest_weights(vertices, lie_on.points[on_arm], weights[on_arm])
    name = side.lower() + " sleeve"
    return Piece(name, vertices, faces, uvs, carried, reach.ravel().astype(np.float32), fabric=fabric, solid=False)
