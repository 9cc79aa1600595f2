"""The monk: a bald old man in a habit to the ankles with wide sleeves, a hood on his back, a rope belt, prayer beads
and sandals."""

from __future__ import annotations

import dataclasses

import numpy as np

from avatarjax.data.body import load_body, shape
from avatarjax.data.wardrobe import (
    assembly,
    beads,
    belts,
    bodice,
    faces,
    footwear,
    headwear,
    patterns,
    skirts,
    tailoring,
)
from avatarjax.data.wardrobe.bones import share
from avatarjax.data.wardrobe.garments import Piece, outline, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.data.wardrobe.skin import visible_skin
from avatarjax.data.wardrobe.sleeves import sleeve_bell
from avatarjax.data.wardrobe.textures import mix, noise

_MACRO = {"caucasian-male-old": 1.0, "universal-male-old-minmuscle-minweight": 0.35}
_HABIT = np.array([182.0, 134.0, 90.0])
_CAPE = np.array([156.0, 110.0, 71.0])
_ROPE = np.array([228.0, 210.0, 170.0])
_BEAD = np.array([104.0, 42.0, 30.0])
_WHITE = np.array([222.0, 216.0, 206.0])
_LEATHER = np.array([110.0, 70.0, 42.0])
_SOLE = 0.014
_ROPE_RADIUS = 0.011


@dataclasses.dataclass(frozen=True, eq=False)
class _Cut:
    """What is where on him, in the rest pose."""

    face: faces.Face
    bodice: bodice.Bodice

    def cape(self, p: np.ndarray) -> np.ndarray:
        """1 on the small round cape to which the hood is sewn."""
        away = (p - np.array([0.0, self.bodice.neck - 0.02, 0.01])) * np.array([1.0, 1.05, 0.75])
        edge = 0.178 - np.linalg.norm(away, axis=1)
        return smoothstep(self.bodice.collar(p), 0.002, -0.002) * smoothstep(edge, -0.003, 0.003)

    def beard(self, p: np.ndarray) -> np.ndarray:
        """1 on the short beard: chin, jaw and upper lip, not the lips."""
        x, y = np.abs(p[:, 0]), p[:, 1] - self.face.eye[1]
        back = self.face.eye[2] - p[:, 2]
        line = -0.0775 + 0.9 * np.clip(x - 0.022, 0, 0.05) + 0.25 * np.clip(back - 0.01, 0, None)
        chin = smoothstep(y - line, 0.004, -0.004) * smoothstep(back, 0.076, 0.062)
        throat = smoothstep(y, -0.142, -0.128)
        upper = faces.blob((x - 0.006) / 0.032, (y + 0.051 + 0.35 * np.clip(x - 0.012, 0, None)) / 0.0075, 0.6)
        corner = faces.blob((x - 0.031) / 0.008, (y + 0.0705) / 0.018, 0.5)
        return np.maximum(chin * throat, np.maximum(upper, corner) * (p[:, 2] > self.face.eye[2] - 0.02))


def look() -> assembly.AvatarMesh:
    """Shape, dress and paint him; about three seconds."""
    body = load_body()
    bare, rig = shape(body, _MACRO)
    eyes, eye, radius = faces.eyeballs(body, bare, margin=0.0)
    face = faces.Face(
        # His lids hang, and his mouth is low.
        eye=eye - np.array([0, 0.0055, 0], np.float32),
        radius=radius,
        skin=np.array([226.0, 176.0, 146.0]),
        brow=_WHITE,
        lips=np.array([178.0, 112.0, 100.0]),
        iris=np.array([92.0, 112.0, 128.0]),
        aperture=0.62,
    )
    waist = float(rig.heads[rig.index("Spine"), 1]) + 0.01
    cut = _Cut(face, bodice.fit(rig, waist=waist, sleeve=0.12, dip=0.035))

    skin = visible_skin(body, bare)
    p = skin.vertices.astype(np.float64)
    dressed, beard = cut.bodice.covered(p), cut.beard(p)
    # The habit is wide: it is bloused over the belt.
    blouse = 0.02 * np.exp(-(((p[:, 1] - waist - 0.07) / 0.06) ** 2))
    thick = (0.002 + 0.011 * cut.bodice.taper(p) + blouse) * dressed + 0.006 * cut.cape(p) + 0.007 * beard
    low = smoothstep(p[:, 1], face.eye[1] - 0.08, face.eye[1] - 0.11)
    chin = beard * low * smoothstep(np.abs(p[:, 0]), 0.06, 0.0)
    # Coarse cloth spans the hollows of an old chest.
    chest = np.hypot((np.abs(p[:, 0]) - 0.075) / 0.075, (p[:, 1] - 1.225) / 0.1) < 1
    skin = tailoring.span(skin, chest & (p[:, 2] > 0.03))
    skin = tailoring.let_out(skin, thick + 0.016 * chin, 0.9 * dressed, rounds=60)
    normals = assembly.vertex_normals(skin.vertices, skin.faces)
    on_trunk = share(rig, skin.weights, "Arm", "Hand") < 0.5
    trunk = skin.vertices[on_trunk]
    lie_on = Ground.at((skin.vertices, normals))

    angles = np.arange(72) * 2 * np.pi / 72
    girdle = trunk[np.abs(trunk[:, 1] - waist) < 0.02][:, [0, 2]]
    centre = np.array([0.0, float(rig.heads[rig.index("Hips"), 2])])
    away = outline(girdle, centre, angles) + 0.6 * _ROPE_RADIUS
    around = np.stack([away * np.sin(angles), np.full(72, waist), away * np.cos(angles) + centre[1]], axis=1)
    belt = belts.rope_belt(around, trunk, skin.weights[on_trunk], radius=_ROPE_RADIUS, rows=72, columns=6)
    skirt = skirts.long_skirt(rig, trunk, top=waist, bottom=0.075, depth=0.052, rows=42, columns=82)
    skirt = _above(skirt, 0.1)
    for x, length in ((0.035, 0.46), (0.062, 0.56)):
        skirt = _rope_end(skirt, x, waist, length)
    sleeves = [
        sleeve_bell(rig, s, lie_on, skin.weights, start=0.075, drop=0.21, rows=24, columns=36)
        for s in ("Left", "Right")
    ]
    string = beads.necklace(rig, lie_on, collar=cut.bodice.neck + 0.001, radius=0.014, depth=0.27)
    rosary = beads.beads(string, skin.vertices, skin.weights, rows=5, columns=6)
    hood = headwear.hood(rig, lie_on, skin.weights, collar=cut.bodice.neck - 0.026)
    sandals = [footwear.sandal(rig, s, skin.vertices, skin.weights, thickness=_SOLE) for s in ("Left", "Right")]

    layers = [
        assembly.Layer(skin, (0.0, 0.0, 0.7, 0.7), lambda p, n, uv: _paint_body(cut, p)),
        assembly.Layer(eyes, (0.9, 0.9, 1.0, 1.0), lambda p, n, uv: faces.paint_eyes(face, p)),
        assembly.Layer(skirt, (0.0, 0.7, 0.7, 1.0), _paint_skirt),
        assembly.Layer(sleeves[0], (0.7, 0.0, 0.85, 0.3), lambda p, n, uv: _paint_sleeve(p, uv)),
        assembly.Layer(sleeves[1], (0.85, 0.0, 1.0, 0.3), lambda p, n, uv: _paint_sleeve(p, uv)),
        assembly.Layer(hood, (0.7, 0.3, 1.0, 0.6), lambda p, n, uv: _paint_hood(p, uv)),
        assembly.Layer(belt, (0.7, 0.6, 0.74, 0.95), lambda p, n, uv: _paint_rope(uv[:, 1] * 52, uv[:, 0])),
        assembly.Layer(rosary, (0.74, 0.6, 1.0, 0.7), _paint_beads),
        assembly.Layer(sandals[0], (0.74, 0.7, 0.87, 0.9), lambda p, n, uv: _paint_sandal(p, uv)),
        assembly.Layer(sandals[1], (0.87, 0.7, 1.0, 0.9), lambda p, n, uv: _paint_sandal(p, uv)),
    ]
    return assembly.assemble("monk", rig, layers, sole=_SOLE)


def _above(piece: Piece, strip: float) -> Piece:
    """The piece with the lower `strip` of its uv square left free."""
    uvs = piece.uvs * np.array([1, 1 - strip], np.float32) + np.array([0, strip], np.float32)
    return dataclasses.replace(piece, uvs=uvs)


def _rope_end(skirt: Piece, x: float, waist: float, length: float) -> Piece:
    """The skirt with a rope end that hangs over its front, `x` metres to his left."""
    front = skirt.vertices[(skirt.vertices[:, 2] > 0) & (np.abs(skirt.vertices[:, 0] - x) < 0.025)]
    heights = waist + 0.005 - np.linspace(0, length, int(length / 0.019))
    ahead = [front[np.abs(front[:, 1] - y) < 0.02][:, 2].max() for y in heights]
    path = np.stack([np.full(len(heights), x), heights, np.array(ahead) + 0.016], axis=1)
    low = 0.0 if x < 0.05 else 0.05
    return belts.hang_rope(skirt, path, strip=(0.0, low, 1.0, low + 0.048))


def _paint_body(cut: _Cut, p: np.ndarray) -> np.ndarray:
    face = cut.face
    colour = faces.age(face, p, faces.paint_skin(face, p))
    x, y = np.abs(p[:, 0]), p[:, 1] - face.eye[1]
    front = p[:, 2] > face.eye[2] - 0.03
    # Bushy brows, over the painted ones.
    bush = faces.blob((x - face.eye[0] - 0.003) / 0.027, (y - 0.024 + 0.12 * np.abs(x - 0.03)) / 0.0058, 0.5)
    colour = mix(colour, _WHITE * (0.95 + 0.12 * noise(p * np.array([1, 0.4, 1]), 0.003, 5))[:, None], front * bush)
    # The shaven crown: a cooler shade where hair would grow.
    scalp = smoothstep(y - 0.075 + 1.2 * np.clip(face.eye[2] - p[:, 2] - 0.03, 0, None), 0.0, 0.04) * (y > -0.06)
    stubble = 0.5 + 0.5 * noise(p, 0.0025, 6)
    grey = np.array([176.0, 158.0, 146.0])
    colour = mix(colour, grey, 0.3 * scalp * stubble * (1 - smoothstep(y, 0.05, 0.09)))
    hairs = noise(p * np.array([1, 0.22, 1]), 0.0035, 7)
    colour = mix(colour, _WHITE * (0.93 + 0.13 * hairs)[:, None], 0.95 * cut.beard(p))
    wool = patterns.woven(p, _HABIT, p[:, :2])
    wool = wool * (1 + 0.06 * np.cos(p[:, 0] / 0.028 + 3 * noise(p, 0.09, 8)))[:, None]
    colour = mix(colour, wool, cut.bodice.covered(p))
    cape = patterns.woven(p, _CAPE, p[:, :2])
    mask = cut.cape(p)
    inner = cut.cape(p + np.array([0, -0.011, 0]) + np.sign(p) * np.array([0.007, 0, 0]))
    cape = mix(cape, _CAPE * 0.7, 0.7 * (1 - inner))
    return mix(colour, cape, mask)


def _paint_skirt(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    v = (uv[:, 1] - 0.1) / 0.9
    colour = patterns.woven(p, _HABIT, np.stack([uv[:, 0] * 1.9, v * 0.96], axis=1), n)
    hem = smoothstep(np.abs(v - 0.035), 0.004, 0.002)
    colour = mix(colour, _HABIT * 0.72, 0.6 * hem)
    # Dust of the road.
    dust = smoothstep(v + 0.05 * noise(p, 0.04, 9), 0.16, 0.0)
    colour = mix(colour, np.array([190.0, 164.0, 130.0]), 0.4 * dust)
    strand = np.where(uv[:, 1] < 0.049, uv[:, 1] / 0.048, (uv[:, 1] - 0.05) / 0.048)
    return np.where((uv[:, 1] < 0.0985)[:, None], _paint_rope(uv[:, 0] * 20, strand), colour)


def _paint_sleeve(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.woven(p, _HABIT, uv * np.array([0.5, 0.45]))
    seam = smoothstep(np.abs(uv[:, 1] - 0.06), 0.008, 0.004)
    colour = mix(colour, _HABIT * 0.72, 0.6 * seam)
    return mix(colour, _HABIT * 0.8, 0.5 * smoothstep(uv[:, 1], 0.06, 0.05))


def _paint_hood(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.woven(p, _CAPE, uv * np.array([0.5, 0.4]))
    colour = mix(colour, _CAPE * 0.72, 0.6 * smoothstep(np.abs(uv[:, 0] - 0.5), 0.006, 0.003))
    return mix(colour, _CAPE * 0.72, 0.5 * smoothstep(np.abs(uv[:, 1] - 0.05), 0.008, 0.004))


def _paint_rope(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Three strands that wind around each other, once in a unit of `along`."""
    wind = (along * 1.5 + across * 2) % 1
    return _ROPE * (0.68 + 0.38 * np.sin(np.pi * wind) ** 0.7)[:, None]


def _paint_beads(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = _BEAD * (1 + 0.25 * noise(p * np.array([1, 0.3, 1]), 0.008, 10))[:, None]
    # Polished wood: a soft light from above.
    return mix(colour, np.array([236.0, 180.0, 150.0]), 0.55 * smoothstep(n @ np.array([0.3, 0.75, 0.59]), 0.8, 1.0))


def _paint_sandal(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = _LEATHER * (1 + 0.12 * noise(p, 0.012, 11))[:, None]
    return mix(colour, _LEATHER * 0.62, smoothstep(p[:, 1], -0.003, -0.006) * (uv[:, 1] < 0.5))
