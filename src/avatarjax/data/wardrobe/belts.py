"""What is worn around the waist: a rope with its hanging ends, and a belt of cartridges."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import paths, tailoring
from avatarjax.data.wardrobe.bones import nearest_weights, one_bone
from avatarjax.data.wardrobe.garments import Piece, facing_out, grid_faces, outline


def rope_belt(
    around: Float[np.ndarray, "n 3"],
    body: Float[np.ndarray, "v 3"],
    weights: Float[np.ndarray, "v j"],
    *,
    radius: float = 0.011,
    rows: int = 84,
    columns: int = 8,
) -> Piece:
    """A rope of a radius (metres) along a closed line (n, 3) around the waist; it moves as the body (v, 3) below."""
    path = paths.even(around, rows, closed=True)
    points = paths.rope(path, np.full(rows, radius), columns, closed=True)
    vertices = points.reshape(-1, 3).astype(np.float32)
    # One ring more in the uvs than in the vertices: the tube is closed both ways.
    faces, uvs = grid_faces(rows + 1, columns, closed=True)
    carried = nearest_weights(vertices, body, weights, 24)
    return Piece("belt", vertices, (faces % len(vertices)).astype(np.int32), uvs, carried, solid=False)


def hang_rope(
    cloth: Piece,
    path: Float[np.ndarray, "n 3"],
    *,
    radius: float = 0.009,
    columns: int = 6,
    strip: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 0.1),
) -> Piece:
    """The cloth with a rope end sewn to its front along a path (n, 3), metres apart from it as drawn.

    The rope is tied to the cloth behind it by braces, since sheets do not collide with each other; three knots thicken
    it. Its uvs fill `strip` (u0, v0, u1, v1) of the piece's square, which the cloth must not use.
    """
    rows = len(path)
    share = np.linspace(0, 1, rows)
    knots = sum(np.exp(-(((share - at) * (rows - 1) / 1.1) ** 2)) for at in (0.62, 0.78, 0.94))
    thick = radius * (1 + 0.55 * knots + 0.5 * (share == 1))
    points = paths.rope(path, thick, columns, closed=False).reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=True)
    low, high = np.array(strip[:2], np.float32), np.array(strip[2:], np.float32)
    # v runs along the rope: turned, it fills a strip that is wider than high.
    uvs = low + uvs[..., ::-1] * (high - low)
    index = np.arange(rows * columns).reshape(rows, columns)
    across = np.concatenate([np.stack([index[:, k], index[:, (k + columns // 2) % columns]], 1) for k in range(3)])
    _, nearest = cKDTree(cloth.vertices).query(points[columns // 2 :: columns], k=3)
    carried = cloth.weights[nearest[:, 0].repeat(columns)]
    reach = np.repeat(1.3 * np.linalg.norm(path - path[0], axis=1) * (share > 1.5 / rows), columns)
    end = Piece("rope", points, faces, uvs, carried, reach.astype(np.float32), across)
    both = tailoring.join(cloth.name, [cloth, end])
    assert both.braces is not None
    tied = np.stack([np.repeat(index[:, columns // 2], 3) + len(cloth.vertices), nearest.ravel()], axis=1)
    braces = np.concatenate([both.braces, tied]).astype(np.int32)
    return dataclasses.replace(both, braces=braces, fabric=cloth.fabric, solid=cloth.solid)


def bullet_belt(
    rig: Rig,
    under: Float[np.ndarray, "v 3"],
    *,
    left: float,
    right: float,
    width: float = 0.042,
    margin: float = 0.006,
    cartridges: int = 34,
    columns: int = 72,
) -> Piece:
    """A belt slung over the hips, from height `left` on the left side to `right` on the other, with brass cartridges in
    its loops all around but for the buckle in front; it rides on the hips outside what is `under` it (v, 3).

    In its uv square the band has (0, 0.5, 1, 1) and the cartridges (0, 0, 1, 0.5), tips up.
    """
    middle = (left + right) / 2
    centre = np.array([0.0, rig.heads[rig.index("Hips"), 2]])

    def loop(angles: np.ndarray, rise: float) -> np.ndarray:
        radius = np.full(len(angles), 0.15)
        for _ in range(4):
            height = middle + (left - right) / 2 * np.sin(angles) * radius / radius.max() + rise
            for k, (angle, y) in enumerate(zip(angles, height, strict=True)):
                slab = under[np.abs(under[:, 1] - y) < 0.022][:, [0, 2]]
                radius[k] = outline(slab, centre, np.array([angle]))[0]
        return np.stack([centre[0] + radius * np.sin(angles), height, centre[1] + radius * np.cos(angles)], axis=1)

    angles = np.arange(columns) * 2 * np.pi / columns
    out = np.stack([np.sin(angles), np.zeros(columns), np.cos(angles)], axis=1)
    # The lower edge stands further out on the hips than the upper edge: the band lies on both.
    high, low = loop(angles, width / 2), loop(angles, -width / 2)
    rows = [high + out * (margin - 0.004), high + out * margin, (high + low) / 2 + out * (margin + 0.002)]
    rows += [low + out * margin, low + out * (margin - 0.004)]
    band, band_uvs = grid_faces(len(rows), columns, closed=True)
    parts = [Piece("band", np.concatenate(rows).astype(np.float32), band, band_uvs, one_bone(rig, "Hips", 5 * columns))]
    parts[0].uvs[..., 1] = 0.5 + 0.5 * parts[0].uvs[..., 1]

    gap = 0.28
    around = np.linspace(gap, 2 * np.pi - gap, cartridges)
    profile = [(-0.024, 0.1), (-0.024, 0.0072), (-0.020, 0.0066), (0.008, 0.0064), (0.013, 0.0048), (0.022, 0.001)]
    profile[0] = (-0.024, 0.001)
    turn = np.arange(7) * 2 * np.pi / 7
    for k, angle in enumerate(around):
        # A cartridge stands along the band where it sits.
        share = angle / (2 * np.pi) * columns
        i, t = int(share) % columns, share % 1
        j = (i + 1) % columns
        top, base = high[i] * (1 - t) + high[j] * t, low[i] * (1 - t) + low[j] * t
        up = (top - base) / np.linalg.norm(top - base)
        far = np.array([np.sin(angle), 0, np.cos(angle)])
        side = np.cross(up, far)
        side /= np.linalg.norm(side)
        far = np.cross(side, up)
        at = (top + base) / 2 + far * (margin + 0.008)
        rings = [
            at + up * h + r * (np.sin(turn)[:, None] * side + np.cos(turn)[:, None] * far) for h, r in reversed(profile)
        ]
        faces, uvs = grid_faces(len(rings), len(turn), closed=True)
        uvs[..., 0] = (k + uvs[..., 0]) / cartridges
        uvs[..., 1] *= 0.48
        points = np.concatenate(rings).astype(np.float32)
        faces, uvs = facing_out(points, faces, uvs, points.mean(0, keepdims=True))
        parts.append(Piece("cartridge", points, faces, uvs, one_bone(rig, "Hips", len(points))))
    # It lies on cloth, which would find itself inside it if it were solid.
    return dataclasses.replace(tailoring.join("bullet belt", parts), solid=False)
