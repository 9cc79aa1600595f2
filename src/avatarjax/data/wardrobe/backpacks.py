"""A backpack: bags, a bedroll and the straps over the shoulders."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import paths, tailoring
from avatarjax.data.wardrobe.bones import nearest_weights, one_bone, share
from avatarjax.data.wardrobe.garments import Piece, facing_out, grid_faces, outline
from avatarjax.data.wardrobe.ground import Ground


def backpack(rig: Rig, under: Piece, *, centre: Float[np.ndarray, "3"], bone: str = "Spine2") -> Piece:
    """A canvas backpack with lid, pockets, bedroll and shoulder straps on the back of what is `under` it.

    `centre` (3,) of the main bag, metres. Places in its uv square: bag (0, 0.4, 0.6, 1), lid (0.6, 0.7, 1, 1), pocket
    in front (0, 0.1, 0.3, 0.4), side pockets (0.3, 0.1, 0.45, 0.4) and (0.45, 0.1, 0.6, 0.4), bedroll
    (0.6, 0.3, 1, 0.7), straps (0.6, 0, 0.8, 0.3) and (0.8, 0, 1, 0.3).
    """

    def box(at: tuple[float, float, float], half: tuple[float, float, float]) -> Piece:
        return rounded_box(rig, "bag", bone, centre + np.array(at), np.array(half), rows=10, columns=20)

    bag = rounded_box(rig, "bag", bone, centre, np.array([0.15, 0.19, 0.085]), rows=16, columns=30)
    lid = box((0.0, 0.165, -0.004), (0.157, 0.045, 0.1))
    bags = [
        (bag, (0.0, 0.4, 0.6, 1.0)),
        (lid, (0.6, 0.7, 1.0, 1.0)),
        (box((0.0, -0.075, -0.088), (0.1, 0.085, 0.035)), (0.0, 0.1, 0.3, 0.4)),
        (box((0.155, -0.075, -0.01), (0.032, 0.09, 0.06)), (0.3, 0.1, 0.45, 0.4)),
        (box((-0.155, -0.075, -0.01), (0.032, 0.09, 0.06)), (0.45, 0.1, 0.6, 0.4)),
        (roll(rig, bone, centre + np.array([0, 0.265, -0.01]), 0.44, 0.064), (0.6, 0.3, 1.0, 0.7)),
    ]
    top, low = float(centre[1]) + 0.12, float(centre[1]) - 0.15
    for x, place in ((0.1, (0.6, 0.0, 0.8, 0.3)), (-0.1, (0.8, 0.0, 1.0, 0.3))):
        bags.append((shoulder_strap(rig, under, x=x, front=float(centre[1]) - 0.02, back=top, low=low), place))
    return tailoring.join("backpack", [piece for piece, _ in bags], [place for _, place in bags])


def rounded_box(
    rig: Rig,
    name: str,
    bone: str,
    centre: Float[np.ndarray, "3"],
    half: Float[np.ndarray, "3"],
    *,
    power: float = 4.0,
    rows: int = 14,
    columns: int = 28,
) -> Piece:
    """A closed box with rounded edges (a superellipsoid of that `power`) about a centre (3,), with half axes (3,),
    metres; rigid on a bone. u of its uvs runs around the vertical, v from 1 at the top to 0."""
    turn = np.arange(columns) * 2 * np.pi / columns
    tilt = np.linspace(0, np.pi, rows)
    # Angles are spread so that the edges of the box get as many vertices as its sides.
    tilt = tilt - 0.14 * np.sin(4 * tilt)
    turn = turn - 0.14 * np.sin(4 * turn)

    def bend(x: np.ndarray) -> np.ndarray:
        return np.sign(x) * np.abs(x) ** (2 / power)

    wide = np.maximum(bend(np.sin(tilt)), 0.03)
    points = np.stack(
        [
            wide[:, None] * bend(np.sin(turn))[None],
            np.broadcast_to(bend(np.cos(tilt))[:, None], (rows, columns)),
            wide[:, None] * bend(np.cos(turn))[None],
        ],
        axis=-1,
    )
    vertices = (centre + half * points).reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(rows, columns, closed=True)
    return Piece(name, vertices, faces, uvs, one_bone(rig, bone, len(vertices)))


def roll(
    rig: Rig,
    bone: str,
    centre: Float[np.ndarray, "3"],
    length: float,
    radius: float,
    *,
    columns: int = 16,
) -> Piece:
    """A rolled blanket that lies along x about a centre (3,), metres; rigid on a bone. v of its uvs runs along it."""
    ends = [(-0.5, 0.04), (-0.5, 0.5), (-0.5, 0.85), (-0.485, 1.0)]
    sides = [(x, 1.0 - 0.06 * (abs(abs(x) - 0.3) < 0.02)) for x in (-0.34, -0.3, -0.26, -0.1, 0.1, 0.26, 0.3, 0.34)]
    profile = np.array(ends + sides + [(-x, r) for x, r in reversed(ends)])
    angles = np.arange(columns) * 2 * np.pi / columns
    x = np.broadcast_to(profile[:, :1] * length, (len(profile), columns))
    y = profile[:, 1:] * radius * np.cos(angles)
    z = profile[:, 1:] * radius * np.sin(angles)
    vertices = (centre + np.stack([x, y, z], axis=-1)).reshape(-1, 3).astype(np.float32)
    faces, uvs = grid_faces(len(profile), columns, closed=True)
    # Rows run along +x here, where the grid takes them to run down.
    faces, uvs = facing_out(vertices, faces, uvs, vertices.mean(0, keepdims=True))
    return Piece("bedroll", vertices, faces, uvs, one_bone(rig, bone, len(vertices)))


def shoulder_strap(
    rig: Rig, under: Piece, *, x: float, front: float, back: float, low: float, lift: float = 0.004
) -> Piece:
    """A backpack's strap on the left (x > 0) or right: from height `back` behind, over the shoulder `x` metres from the
    middle, down to `front` on the chest, and under the arm back to height `low` behind."""
    p = under.vertices.astype(np.float64)
    side = np.sign(x)
    # Over the shoulder it follows the convex outline in the plane of x.
    slab = p[np.abs(p[:, 0] - x) < 0.035][:, [2, 1]]
    slab = slab[slab[:, 1] > min(front, back) - 0.05]
    centre = np.array([slab[:, 0].mean(), front])
    turn = np.linspace(-np.pi / 2, np.pi / 2, 25)
    r = outline(slab, centre, turn) + lift
    over = np.stack([np.full(25, x), centre[1] + r * np.cos(turn), centre[0] + r * np.sin(turn)], axis=1)
    over = over[~((over[:, 2] < centre[0]) & (over[:, 1] < back))]
    # Under the arm it follows the level outline of the trunk.
    body = share(rig, under.weights, "Arm", "Hand") < 0.35
    trunk = p[(np.abs(p[:, 1] - front) < 0.06) & body][:, [0, 2]]
    middle = np.array([0.0, trunk[:, 1].mean()])
    start = np.arctan2(x, over[-1, 2] - middle[1])
    turn = side * np.linspace(abs(start) + 0.12, 2.75, 16)
    r = outline(trunk, middle, turn) + lift
    round_ = np.stack(
        [middle[0] + r * np.sin(turn), np.linspace(front - 0.015, low, 16), middle[1] + r * np.cos(turn)], axis=1
    )
    path = np.concatenate([over, round_])
    smooth = path.copy()
    for _ in range(3):
        smooth[1:-1] = (smooth[:-2] + 2 * smooth[1:-1] + smooth[2:]) / 4
    depth, normal = Ground.of([under]).clearance(smooth)
    smooth += normal * np.clip(lift - depth, 0, 0.03)[:, None]
    return strap("strap", smooth, normal, under)


def strap(
    name: str,
    path: Float[np.ndarray, "n 3"],
    outward: Float[np.ndarray, "n 3"],
    under: Piece,
    *,
    width: float = 0.036,
    thickness: float = 0.008,
) -> Piece:
    """A flat strap along a path (n, 3), whose face looks `outward` (n, 3); it moves as what is under it does. `width`
    and `thickness`, metres."""
    side, out = paths.frame(paths.tangents(path), outward)
    corners = [(-0.5, 0.0), (-0.5, 0.8), (-0.3, 1.0), (0.3, 1.0), (0.5, 0.8), (0.5, 0.0)]
    rings = np.stack([path - side * width * a + out * thickness * b for a, b in corners], axis=1)
    vertices = rings.reshape(-1, 3)
    faces, uvs = grid_faces(len(path), len(corners), closed=True)
    faces, uvs = facing_out(vertices, faces, uvs, np.repeat(rings.mean(1), len(corners), axis=0))
    weights = nearest_weights(vertices.astype(np.float32), under.vertices, under.weights)
    return Piece(name, vertices.astype(np.float32), faces, uvs, weights)
