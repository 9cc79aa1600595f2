"""Things on strings: a rope belt, its hanging ends, and a string of big beads."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import drape
from avatarjax.data.wardrobe.accessories import nearest_weights
from avatarjax.data.wardrobe.garments import Piece, grid_faces


def tube(path: Float[np.ndarray, "n 3"], radius: Float[np.ndarray, " n"], columns: int, *, closed: bool) -> np.ndarray:
    """Rings (n, columns, 3) of the radii (n,) around a path (n, 3), metres; the first vertex of each is outermost from
    the y axis or, where the path is upright, ahead."""
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    outer = path * np.array([1.0, 0, 1.0])
    outer -= (outer * along).sum(1, keepdims=True) * along
    outer /= np.linalg.norm(outer, axis=1, keepdims=True)
    other = np.cross(along, outer)
    angles = np.arange(columns) * 2 * np.pi / columns
    ring = np.cos(angles)[None, :, None] * outer[:, None] + np.sin(angles)[None, :, None] * other[:, None]
    return path[:, None] + radius[:, None, None] * ring


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
    path = drape.even(around, rows, closed=True)
    points = tube(path, np.full(rows, radius), columns, closed=True)
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
    points = tube(path, thick, columns, closed=False).reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=True)
    low, high = np.array(strip[:2], np.float32), np.array(strip[2:], np.float32)
    # v runs along the rope: turned, it fills a strip that is wider than high.
    uvs = low + uvs[..., ::-1] * (high - low)
    start = len(cloth.vertices)
    index = start + np.arange(rows * columns).reshape(rows, columns)
    across = np.concatenate([np.stack([index[:, k], index[:, (k + columns // 2) % columns]], 1) for k in range(3)])
    _, nearest = cKDTree(cloth.vertices).query(points[columns // 2 :: columns], k=3)
    tied = np.stack([np.repeat(index[:, columns // 2], 3), nearest.ravel()], axis=1)
    old = np.zeros((0, 2), np.int32) if cloth.braces is None else cloth.braces
    assert cloth.reach is not None
    reach = np.repeat(1.3 * np.linalg.norm(path - path[0], axis=1) * (share > 1.5 / rows), columns)
    return dataclasses.replace(
        cloth,
        vertices=np.concatenate([cloth.vertices, points]),
        faces=np.concatenate([cloth.faces, faces + start]).astype(np.int32),
        uvs=np.concatenate([cloth.uvs, uvs]).astype(np.float32),
        weights=np.concatenate([cloth.weights, cloth.weights[nearest[:, 0].repeat(columns)]]),
        reach=np.concatenate([cloth.reach, reach]).astype(np.float32),
        braces=np.concatenate([old, across, tied]).astype(np.int32),
    )


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


def necklace(
    rig: Rig, lie_on: drape.Ground, *, collar: float, radius: float, depth: float, apart: float = 2.05
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
    return drape.even(string, count, closed=True)
