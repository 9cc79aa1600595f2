"""Hair that hangs: braids, wild locks and a beard as tubes of strands, and long hair as sheets beside the face."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Rig
from avatarjax.data.wardrobe import drape, fabrics, paths, tailoring
from avatarjax.data.wardrobe.bones import head_then_chest, one_bone
from avatarjax.data.wardrobe.garments import Piece, facing_out, grid_faces, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.data.wardrobe.textures import mix
from avatarjax.physics.cloth import Fabric


def strands(
    name: str,
    path: Float[np.ndarray, "n 3"],
    aside: Float[np.ndarray, "3"],
    widths: Float[np.ndarray, " n"],
    depths: Float[np.ndarray, " n"],
    weights: Float[np.ndarray, "n j"],
    reach: Float[np.ndarray, " n"],
    *,
    columns: int = 10,
    fabric: Fabric = fabrics.HAIR,
) -> Piece:
    """A tube of elliptic rings about a path (n, 3), which should end in small ones.

    The half axes (n,) of the ellipses, metres, lie towards `aside` (3,) and across it and the path. All vertices of a
    ring have its weights (n, j) and reach (n,); braces join those that are opposite, and rings two apart along the path
    on four sides, so that the tube keeps its section and resists kinks.
    """
    # Rings turn about the vertical only, where a section that minimises twist would drift.
    across, side = paths.frame(paths.tangents(path), aside)
    vertices = paths.rings(path, depths[:, None] * across, widths[:, None] * side, columns).reshape(-1, 3)
    faces, uvs = grid_faces(len(path), columns, closed=True)
    faces, uvs = facing_out(vertices, faces, uvs, np.repeat(path, columns, axis=0))
    index = np.arange(len(vertices)).reshape(len(path), columns)
    half = columns // 2
    opposite = np.stack([index[:, :half], index[:, half : 2 * half]], axis=-1).reshape(-1, 2)
    quarters = np.arange(0, columns, max(columns // 4, 1))[:4]
    stiff = np.stack([index[:-2, quarters], index[2:, quarters]], axis=-1).reshape(-1, 2)
    return Piece(
        name,
        vertices.astype(np.float32),
        faces,
        uvs,
        np.repeat(weights, columns, axis=0).astype(np.float32),
        np.repeat(reach, columns).astype(np.float32),
        np.concatenate([opposite, stiff]).astype(np.int32),
        fabric,
        solid=False,
    )


def braid(
    rig: Rig,
    name: str,
    knots: Float[np.ndarray, "k 3"],
    ground: Ground,
    *,
    root: str = "Head",
    width: float = 0.026,
    plaits: int = 9,
    sewn: float = 0.06,
    margin: float = 0.012,
    rows: int = 44,
    columns: int = 10,
) -> Piece:
    """A braid along knots (k, 3) from the scalp, held clear of the ground; it hangs from the bone `root`.

    `width` is its half width and `sewn` the length that does not swing, metres. Its width pulses with the plaits, and
    it ends in a tie and a tuft.
    """
    path = paths.through(knots, rows)
    hangs = smoothstep(np.linspace(0, 1, rows), 0.03, 0.16)
    path = _hang(path, ground, margin + width, hangs, rounds=2)
    s = np.linspace(0, 1, rows)
    pulse = 0.86 + 0.14 * np.abs(np.cos(np.pi * plaits * s / 0.86))
    taper = width * (1 - 0.25 * s) * pulse
    # The tie is narrow, and the tuft below it opens and closes to a tip.
    tuft = np.interp(s, [0.86, 0.89, 0.94, 0.98, 1.0], [0.55, 0.6, 0.85, 0.6, 0.25])
    radius = np.where(s < 0.86, taper, width * 0.75 * tuft) * np.interp(s, [0, 0.04], [0.6, 1])
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    reach = 1.3 * np.clip(s * length - sewn, 0, None)
    weights = one_bone(rig, root, rows)
    return strands(name, path, np.array([1.0, 0, 0]), radius, 0.85 * radius, weights, reach, columns=columns)


def _hang(path: np.ndarray, ground: Ground, gap: np.ndarray | float, hangs: np.ndarray, rounds: int = 1) -> np.ndarray:
    """Points (n, 3) evenly along the path, held `gap` metres clear of the ground where it `hangs`, (n,) in [0, 1]."""
    for _ in range(4):
        path = ground.hold_clear(path, gap * hangs - (1 - hangs), rounds=rounds)
        path[1:-1] = (path[:-2] + 2 * path[1:-1] + path[2:]) / 4
    return paths.through(path, len(path))


def paint_braid(
    uv: Float[np.ndarray, "n 2"], hair: Float[np.ndarray, "3"], tie: Float[np.ndarray, "3"], plaits: int = 9
) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) in 0..255 of a `braid`: strands cross in chevrons with dark gaps, a `tie` holds the tuft."""
    s, turn = 1 - uv[:, 1], uv[:, 0] * 2 * np.pi
    # Seen from the front or the back, each strand runs down from its edge to the middle.
    slant = np.abs(np.sin(turn))
    phase = s / 0.86 * plaits - 0.45 * slant + 0.5 * (np.sin(turn) > 0)
    place = np.abs(phase % 1 - 0.5) * 2
    fine = np.sin(15 * phase) * 0.05
    colour = hair * (1.06 - 0.34 * smoothstep(place, 0.55, 1.0) + fine)[:, None]
    colour = mix(colour, hair * 0.5, 0.7 * smoothstep(slant, 0.16, 0.05) * (s < 0.86))
    tuft = hair * (1.05 + 0.12 * np.sin(23 * turn))[:, None]
    colour = mix(colour, tuft, smoothstep(s, 0.875, 0.88))
    return mix(colour, tie, smoothstep(s, 0.845, 0.85) * smoothstep(s, 0.89, 0.885))


def full_beard(
    rig: Rig,
    ground: Ground,
    chin: Float[np.ndarray, "3"],
    *,
    jaw: float,
    bottom: float,
    width: float = 0.07,
    depth: float = 0.03,
    margin: float = 0.012,
    rows: int = 26,
    columns: int = 24,
) -> Piece:
    """A long beard that grows from the chin (3,) and hangs before the chest to height `bottom`.

    It starts at height `jaw` under the lower lip, inside the face; `width` and `depth` are its half axes at the chin,
    metres. Above the chin it is sewn to the head, below it hangs clear of the ground.
    """
    knots = np.array(
        [
            [0, jaw, chin[2] - 0.03],
            [0, chin[1], chin[2] - 0.004],
            [0, 0.6 * chin[1] + 0.4 * bottom, chin[2] + 0.002],
            [0, 0.3 * chin[1] + 0.7 * bottom, chin[2] + 0.006],
            [0, bottom, chin[2] + 0.01],
        ]
    )
    path = paths.through(knots, rows)
    s = np.linspace(0, 1, rows)
    wide = width * np.interp(s, [0, 0.2, 0.45, 0.75, 0.93, 1], [0.8, 1.0, 0.98, 0.66, 0.3, 0.1])
    deep = depth * np.interp(s, [0, 0.2, 0.5, 0.8, 1], [0.8, 1.0, 0.95, 0.6, 0.12])
    # The roots are in the skin; further down the whole tube is before the chest.
    share = smoothstep(chin[1] - path[:, 1], 0.02, 0.07)
    for _ in range(4):
        held = ground.hold_clear(path, (margin + deep) * share - (1 - share), rounds=1)
        path[:, 2] = held[:, 2]
        path[1:-1] = (path[:-2] + 2 * path[1:-1] + path[2:]) / 4
    path[:, 0] = 0
    fall = paths.walked(path)
    start = np.interp(0.0, chin[1] - 0.045 - path[:, 1], fall)
    reach = 1.3 * np.clip(fall - start, 0, None)
    weights = one_bone(rig, "Head", rows)
    piece = strands("beard", path, np.array([1.0, 0, 0]), wide, deep, weights, reach, columns=columns)
    points = piece.vertices.astype(np.float64).reshape(rows, columns, 3)
    # Locks: the surface is ridged along the strands, and the tip is ragged.
    angle = np.arange(columns) * 2 * np.pi / columns
    lock = 1 + 0.07 * np.sin(5 * angle + 0.7) * smoothstep(s, 0.15, 0.4)[:, None]
    centre = points.mean(1, keepdims=True)
    points = centre + (points - centre) * lock[..., None]
    return dataclasses.replace(piece, vertices=points.reshape(-1, 3).astype(np.float32))


def locks(
    rig: Rig,
    roots: Float[np.ndarray, "k 3"],
    outward: Float[np.ndarray, "k 3"],
    ground: Ground,
    *,
    bottom: float,
    behind: float,
    radius: float = 0.021,
    sewn: float = 0.05,
    margin: float = 0.008,
    rows: int = 18,
    columns: int = 8,
    seed: int = 80,
) -> Piece:
    """Thick locks of wild hair, one tube from each root (k, 3) on the scalp, where the skin faces `outward` (k, 3).

    They part from the head by their thickness, `radius` metres, and hang over the ground to about height `bottom`, at
    z = `behind` or nearer; no two are alike, but the same every time. The first `sewn` metres do not swing.
    """
    rng = np.random.default_rng(seed)
    tubes = []
    for root, out in zip(roots.astype(np.float64), outward.astype(np.float64), strict=True):
        low = bottom + rng.uniform(-0.04, 0.04)
        level = out * np.array([1, 0, 1]) / max(np.linalg.norm(out[[0, 2]]), 1e-6)
        sway = 0.012 * rng.normal(size=(3, 3)) * np.array([1, 0.3, 1])
        thick = radius * rng.uniform(0.85, 1.2)
        start = root - 0.006 * out
        # They fall to the back, and not onto the shoulders.
        tip = np.array([0.95 * start[0], low, min(start[2], behind)])
        knots = [start, start + level * thick + np.array([0, -0.02, 0])]
        for k, share in enumerate((0.4, 0.75, 1.0)):
            back = np.array([share, share, share**0.8])
            knots.append(start + back * (tip - start) + (1.2 + share) * thick * level + sway[k])
        knots = np.array(knots)
        path = paths.through(knots, rows)
        s = np.linspace(0, 1, rows)
        girth = thick * np.interp(s, [0, 0.15, 0.5, 0.85, 1], [0.75, 1.0, 1.05, 0.6, 0.16])
        hangs = smoothstep(s, 0.08, 0.25)
        path = _hang(path, ground, margin + girth, hangs)
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        reach = 1.3 * np.clip(s * length - sewn, 0, None)
        aside = np.array([level[2], 0, -level[0]])
        weights = one_bone(rig, "Head", rows)
        tubes.append(strands("hair", path, aside, girth, 0.8 * girth, weights, reach, columns=columns))
    for k, t in enumerate(tubes):
        # Each lock has a strip of the uv square of its own.
        uvs = t.uvs * np.array([0.96 / len(tubes), 1], np.float32) + np.array([k / len(tubes), 0], np.float32)
        tubes[k] = dataclasses.replace(t, uvs=uvs)
    hair = tailoring.join("hair", tubes)
    # Where a tube as a whole went astray between two surfaces, its own vertices give way.
    vertices, free = hair.vertices.copy(), np.concatenate([t.reach > 0 for t in tubes])
    vertices[free] = ground.hold_clear(vertices[free], 0.011, rounds=5)
    return dataclasses.replace(hair, vertices=vertices, fabric=fabrics.HAIR, solid=False)


def front_hair(
    rig: Rig,
    side: str,
    lie_on: Ground,
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
    roots = lie_on.clear(paths.even(drape.outward(head, centre, up), columns), 0.006)

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
    points = drape.settle(points, lie_on, 0.8 * gap)
    gone = paths.walked(points)
    faces, uvs = grid_faces(rows, columns, closed=False)
    if side == "Right":
        faces, uvs = faces[:, ::-1].copy(), uvs[:, ::-1].copy()
    vertices = points.reshape(-1, 3).astype(np.float32)
    # On the head it is combed down; what hangs is free.
    reach = 1.3 * np.clip(gone - 0.15, 0, None)
    weights = head_then_chest(rig, vertices)
    name = side.lower() + " hair"
    return Piece(name, vertices, faces, uvs, weights, reach.ravel().astype(np.float32), fabric=fabric, solid=False)
