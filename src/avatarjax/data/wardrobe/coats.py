"""The upper part of an open coat, which rides on the body like a thick jacket, and the collar that stands on it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import fabrics, tailoring
from avatarjax.data.wardrobe.bones import limb, nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces, outline, smoothstep
from avatarjax.physics.cloth import Fabric


def front_opening(p: Float[np.ndarray, "n 3"], edge: np.ndarray | float, middle: float) -> Float[np.ndarray, " n"]:
    """Metres (n,) from the open front of a garment, positive on the garment: it ends `edge` metres, () or (n,), to the
    left and right of the middle, on the side of the body before z = `middle`."""
    return np.maximum(np.abs(p[:, 0]) - edge, middle - p[:, 2])


def sleeve_end(rig: Rig, p: Float[np.ndarray, "n 3"], beyond: float = 0.0) -> Float[np.ndarray, " n"]:
    """Metres (n,) before the end of a sleeve, which lies `beyond` metres past the wrist; large off the arms."""
    return beyond - limb(rig, "ForeArm", "Hand", "Hand").along(p)


def coat_top(
    rig: Rig,
    shell: Piece,
    *,
    waist: float,
    neck: float,
    edge: tuple[float, float] = (0.07, 0.085),
    thickness: float = 0.02,
    fabric: Fabric = fabrics.DENIM,
) -> Piece:
    """The upper part of a coat, with sleeves, from a close shell of the whole body.

    It reaches from height `waist` to about `neck`, metres, and is open in front: `edge` are half the widths of the
    opening at the waist and at the chest. `thickness` is how far it lies outside the shell.
    """
    p = shell.vertices.astype(np.float64)
    rise = (p[:, 1] - waist) / (neck - waist)
    edges = np.interp(rise, [0, 0.6, 1], [edge[0], edge[1], edge[1] - 0.012])
    levels = [
        p[:, 1] - waist,
        front_opening(p, edges, 0.035),
        sleeve_end(rig, p, 0.012),
        neck - p[:, 1] + 0.55 * np.abs(p[:, 0]),
    ]
    top = tailoring.clip(shell, np.min(levels, axis=0))
    q = top.vertices
    # Sleeves narrow towards the wrist, where they end in a cuff.
    before = sleeve_end(rig, q.astype(np.float64), 0.012)
    cuff = smoothstep(before, 0.075, 0.06) * smoothstep(before, -0.02, 0.0)
    thick = thickness - 0.004 * smoothstep(before, 0.3, 0.1) + 0.005 * cuff
    # More rounds would make the sleeves as thin as the arms in them.
    top = tailoring.let_out(top, thick, smooth=0.5, rounds=4)
    return dataclasses.replace(tailoring.spread_uvs(top), name="coat", fabric=fabric)


def collar(
    rig: Rig,
    under: Float[np.ndarray, "v 3"],
    coat: Piece,
    *,
    base: float,
    gap: float = 0.75,
    height: float = 0.05,
    columns: int = 30,
) -> Piece:
    """A folded collar around the neck `under` it (v, 3), which moves with the `coat`.

    At the back it stands at height `base`, to the front it sinks and opens over `gap` radians to either side.
    """
    angles = np.linspace(gap, 2 * np.pi - gap, columns)
    near = under[(np.abs(under[:, 1] - base + 0.005) < 0.018) & (np.abs(under[:, 0]) < 0.075)][:, [0, 2]]
    centre = (near.min(0) + near.max(0)) / 2
    radius = outline(near, centre, angles)
    sunk = 0.045 * smoothstep(np.cos(angles), -0.3, 0.8)
    profile = [(0.02, -0.012), (0.012, 0.5), (0.012, 0.9), (0.018, 1.05), (0.027, 0.9), (0.037, 0.45), (0.048, -0.02)]
    rows = []
    for out, up in profile:
        r = radius + out * (1 + 0.35 * np.cos(angles)) + 0.004
        rise = base - sunk + (up * height if up > 0 else up)
        rows.append(np.stack([centre[0] + r * np.sin(angles), rise, centre[1] + r * np.cos(angles)], axis=1))
    vertices = np.concatenate(rows).astype(np.float32)
    faces, uvs = grid_faces(len(rows), columns, closed=False)
    return Piece("collar", vertices, faces, uvs, nearest_weights(vertices, coat.vertices, coat.weights), solid=False)
