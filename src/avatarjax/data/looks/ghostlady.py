"""The ghost lady: a thin, pale young woman with long black hair, in a white dress to the floor with wide sleeves, and a
torn veil."""

from __future__ import annotations

import dataclasses

import numpy as np

from avatarjax.data.body import load_body, shape
from avatarjax.data.wardrobe import assembly, bodice, fabrics, faces, hair, headwear, patterns, skirts, tailoring
from avatarjax.data.wardrobe.bones import share
from avatarjax.data.wardrobe.garments import smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.data.wardrobe.skin import visible_skin
from avatarjax.data.wardrobe.sleeves import sleeve_bell
from avatarjax.data.wardrobe.textures import mix, noise

_MACRO = {"asian-female-young": 1.0, "universal-female-young-minmuscle-minweight": 0.6}
_DRESS = np.array([204.0, 208.0, 216.0])
_VEIL = np.array([142.0, 156.0, 178.0])
_HAIR = np.array([52.0, 48.0, 54.0])
_SKIN = np.array([212.0, 206.0, 206.0])
_SHADE = np.array([112.0, 96.0, 116.0])


@dataclasses.dataclass(frozen=True, eq=False)
class _Cut:
    """What is where on her, in the rest pose."""

    face: faces.Face
    bodice: bodice.Bodice

    def scalp(self, p: np.ndarray) -> np.ndarray:
        """1 under the hair: behind a line from the forehead past the temples to the nape."""
        y, back = p[:, 1] - self.face.eye[1], self.face.eye[2] - p[:, 2]
        line = np.maximum(0.072 - 10 * p[:, 0] ** 2 - 1.1 * np.clip(back - 0.022, 0, None), -0.06)
        return smoothstep(y - line, -0.006, 0.006) * (y > -0.09)


def look() -> assembly.AvatarMesh:
    """Shape, dress and paint her; about three seconds."""
    body = load_body()
    bare, rig = shape(body, _MACRO)
    eyes, eye, radius = faces.eyeballs(body, bare, margin=0.0)
    face = faces.Face(
        eye=eye - np.array([0, 0.003, 0], np.float32),
        radius=radius,
        skin=_SKIN,
        brow=np.array([74.0, 66.0, 70.0]),
        lips=np.array([142.0, 96.0, 108.0]),
        iris=np.array([120.0, 134.0, 146.0]),
        aperture=0.75,
    )
    waist = float(rig.heads[rig.index("Spine"), 1]) + 0.055
    cut = _Cut(face, bodice.fit(rig, waist=waist, sleeve=0.1, dip=0.04))

    skin = visible_skin(body, bare)
    p = skin.vertices.astype(np.float64)
    dressed, scalp = cut.bodice.covered(p), cut.scalp(p)
    # Her ears are flat under the hair.
    away = p - eye - np.array([0, -0.012, -0.095])
    skin = tailoring.span(skin, (np.hypot(away[:, 1] / 0.045, away[:, 2] / 0.04) < 1) & (np.abs(p[:, 0]) > 0.05))
    thick = (0.001 + 0.006 * cut.bodice.taper(p)) * dressed + 0.009 * scalp
    skin = tailoring.let_out(skin, thick, 0.8 * dressed + 0.3 * scalp, rounds=30)
    normals = assembly.vertex_normals(skin.vertices, skin.faces)
    arms = share(rig, skin.weights, "Arm", "Hand")
    trunk = skin.vertices[arms < 0.5]
    lie_on = Ground.at((skin.vertices, normals))
    torso = Ground.at((skin.vertices[arms < 0.6], normals[arms < 0.6]))
    middle = np.array([0.0, face.eye[1] + 0.035, face.eye[2] - 0.085])

    cotton = fabrics.COTTON
    skirt = skirts.long_skirt(
        rig, trunk, top=waist, bottom=0.035, flare=0.19, depth=0.05, folds=17, rows=41, columns=80, fabric=cotton
    )
    sleeves = [
        sleeve_bell(
            rig, s, lie_on, skin.weights, start=0.055, past_wrist=0.0, drop=0.27, width=0.035, fabric=cotton, columns=34
        )
        for s in ("Left", "Right")
    ]
    strands = [
        hair.front_hair(rig, s, torso, middle, length=0.64, hairline=0.62, crown=1.85, temple=0.031)
        for s in ("Left", "Right")
    ]
    combed = [(h.vertices, assembly.vertex_normals(h.vertices, h.faces)) for h in strands]
    veil = headwear.veil(
        rig, Ground.at((torso.points, torso.normals), *combed), middle, length=0.98, rows=46, columns=44
    )

    layers = [
        assembly.Layer(skin, (0.0, 0.0, 0.7, 0.7), lambda p, n, uv: _paint_body(cut, p)),
        assembly.Layer(eyes, (0.9, 0.9, 1.0, 1.0), lambda p, n, uv: faces.paint_eyes(face, p)),
        assembly.Layer(skirt, (0.0, 0.7, 0.7, 1.0), _paint_skirt),
        assembly.Layer(sleeves[0], (0.7, 0.0, 0.85, 0.25), _paint_sleeve),
        assembly.Layer(sleeves[1], (0.85, 0.0, 1.0, 0.25), _paint_sleeve),
        assembly.Layer(veil, (0.7, 0.25, 1.0, 0.62), _paint_veil),
        assembly.Layer(strands[0], (0.7, 0.62, 0.85, 0.9), _paint_hair),
        assembly.Layer(strands[1], (0.85, 0.62, 1.0, 0.9), _paint_hair),
    ]
    return assembly.assemble("ghostlady", rig, layers)


def _paint_body(cut: _Cut, p: np.ndarray) -> np.ndarray:
    colour = faces.paint_skin(cut.face, p)
    # No blood in her cheeks: half of the colour is taken out of the skin.
    grey = colour.mean(1, keepdims=True) * np.array([0.99, 1.0, 1.03])
    colour = mix(colour, grey, 0.55)
    colour = faces.sockets(cut.face, p, colour, _SHADE)
    veins = smoothstep(np.abs(noise(p, 0.035, 21)), 0.05, 0.0)
    colour = mix(colour, np.array([176.0, 182.0, 200.0]), 0.3 * veins)
    strands = noise(p * np.array([1, 0.25, 1]), 0.004, 3)
    colour = mix(colour, _HAIR * (0.95 + 0.2 * strands)[:, None], cut.scalp(p))
    cloth = patterns.woven(p, _DRESS, p[:, :2], coarse=0.025)
    level = cut.bodice.collar(p)
    cloth = mix(cloth, _DRESS * 0.82, 0.7 * smoothstep(np.abs(level + 0.012), 0.004, 0.002))
    sash = smoothstep(p[:, 1], cut.bodice.waist + 0.035, cut.bodice.waist + 0.03)
    cloth = mix(cloth, _DRESS * np.array([0.74, 0.77, 0.82]), 0.8 * sash * (cut.bodice.along(p) < 0))
    return mix(colour, cloth, cut.bodice.covered(p))


def _paint_skirt(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.woven(p, _DRESS, uv * np.array([1.9, 0.95]), n, coarse=0.025, shade=0.26)
    v = uv[:, 1]
    stain = smoothstep(v + 0.08 * noise(p, 0.05, 9) + 0.04 * noise(p, 0.015, 8), 0.26, 0.0)
    return mix(colour, np.array([150.0, 150.0, 152.0]), 0.6 * stain)


def _paint_sleeve(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.woven(p, _DRESS, uv * np.array([0.6, 0.45]), coarse=0.025)
    colour = colour * (1 + 0.06 * np.cos(uv[:, 0] * 2 * np.pi * 7) * smoothstep(uv[:, 1], 0.9, 0.3))[:, None]
    stain = smoothstep(uv[:, 1] + 0.1 * noise(p, 0.03, 10), 0.2, 0.0)
    return mix(colour, np.array([160.0, 162.0, 168.0]), 0.6 * stain)


def _paint_veil(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.woven(p, _VEIL, uv * np.array([0.7, 1.0]), coarse=0.05)
    folds = 0.07 * np.cos(7.2 * (uv[:, 0] - 0.5) * 3.5) * smoothstep(uv[:, 1], 0.7, 0.4)
    colour = colour * (1 + folds)[:, None]
    edge = np.minimum(uv[:, 0], 1 - uv[:, 0])
    colour = mix(colour, _VEIL * 1.22, 0.7 * smoothstep(edge, 0.03, 0.022))
    # Lace at the band, and dirt where it is torn.
    colour = mix(colour, _VEIL * 1.25, 0.8 * smoothstep(uv[:, 1], 0.978, 0.984))
    stain = smoothstep(uv[:, 1] + 0.12 * noise(p, 0.04, 11), 0.2, 0.0)
    return mix(colour, np.array([118.0, 122.0, 132.0]), 0.6 * stain)


def _paint_hair(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    across = uv[:, 0] + 0.006 * np.sin(uv[:, 1] * 14 + uv[:, 0] * 40)
    line = np.stack([across * 0.5, uv[:, 1] * 0.02, np.zeros(len(uv))], axis=1)
    streak = 0.3 * noise(line, 0.006, 12) + 0.25 * noise(line, 0.02, 13)
    # A cold sheen where the hair turns down from the crown.
    sheen = 0.5 * np.exp(-(((uv[:, 1] - 0.86) / 0.05) ** 2))
    return _HAIR * (1 + streak + sheen)[:, None] * np.array([1.0, 1.0, 1.06])
