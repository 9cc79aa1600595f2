"""The cowgirl: a young woman in a shirt, a leather vest and a knee-length denim skirt, with two braids, boots, a hat
and a belt of cartridges."""

from __future__ import annotations

import dataclasses

import numpy as np

from avatarjax.data.body import Rig, load_body, shape
from avatarjax.data.wardrobe import (
    assembly,
    belts,
    bodice,
    faces,
    footwear,
    hair,
    headwear,
    patterns,
    skirts,
    tailoring,
)
from avatarjax.data.wardrobe.bones import Limb, limb, share
from avatarjax.data.wardrobe.garments import Piece, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.data.wardrobe.skin import body_piece
from avatarjax.data.wardrobe.textures import mix, noise

_MACRO = {"caucasian-female-young": 1.0, "universal-female-young-averagemuscle-minweight": 0.25}
_SHIRT = np.array([240.0, 229.0, 208.0])
_VEST = np.array([132.0, 80.0, 46.0])
_BANDANA = np.array([186.0, 42.0, 40.0])
_DENIM = np.array([66.0, 96.0, 150.0])
_HEM = np.array([236.0, 220.0, 190.0])
_BELT = np.array([78.0, 44.0, 26.0])
_BRASS = np.array([214.0, 176.0, 88.0])
_BOOT = np.array([112.0, 62.0, 34.0])
_HAIR = np.array([196.0, 150.0, 90.0])
_FELT = np.array([176.0, 132.0, 84.0])
_SOLE = 0.012


@dataclasses.dataclass(frozen=True, eq=False)
class _Cut:
    """Where her clothes end, metres in the rest pose: heights, and coordinates along and across the left arm."""

    face: faces.Face
    arm: Limb
    elbow: float
    neck: float
    waist: float

    def sleeve(self, p: np.ndarray) -> np.ndarray:
        """Metres from the shoulder joint along the upper arm, on the arm; minus one elsewhere."""
        return bodice.down_the_arm(self.arm, p)

    def collar(self, p: np.ndarray) -> np.ndarray:
        """Metres above the neckline, which is lower in front than behind and runs over the shoulders."""
        level = self.neck - 0.012 - 0.35 * np.clip(p[:, 2], -0.02, 0.06)
        return p[:, 1] - level - 0.8 * np.clip(np.abs(p[:, 0]) - 0.055, 0, None)

    def torso(self, p: np.ndarray) -> np.ndarray:
        """1 where the shirt is: below the neckline, above the waist, and on the arms to below the elbow."""
        along = self.sleeve(p)
        covered = smoothstep(self.collar(p), 0.004, -0.004) * smoothstep(along, self.elbow + 0.035, self.elbow + 0.025)
        return covered * np.where(along > -0.5, 1.0, smoothstep(p[:, 1], self.waist - 0.05, self.waist - 0.04))

    def vest(self, p: np.ndarray) -> np.ndarray:
        """1 where the vest lies over the shirt: not on the arms, and open in a V at the front."""
        x, low = np.abs(p[:, 0]) - self.arm.joint[0], self.arm.joint[1] - p[:, 1]
        # The armhole is a straight line over the shoulder and round under the arm.
        armhole = np.minimum(x + 0.035, 0.065 - np.hypot(np.minimum(x - 0.03, 0), np.clip(low - 0.02, 0, None)))
        opening = 0.022 + 0.30 * np.clip(p[:, 1] - self.waist - 0.1, 0, None)
        open_front = smoothstep(np.abs(p[:, 0]), opening, opening - 0.004) * (p[:, 2] > 0.03)
        below = smoothstep(self.collar(p), -0.012, -0.016)
        on_arm = smoothstep(self.sleeve(p), 0.05, 0.056)
        return self.torso(p) * below * (1 - open_front) * (1 - on_arm) * smoothstep(armhole, 0.002, -0.002)

    def bandana(self, p: np.ndarray) -> np.ndarray:
        """1 on the band around the neck, which hangs to a point in front."""
        point = 0.05 * np.clip(1 - np.abs(p[:, 0]) / 0.06, 0, 1) * (p[:, 2] > 0.02)
        level = self.collar(p)
        inside = (np.abs(p[:, 0]) < 0.09) & (p[:, 1] > self.neck - 0.14)
        return smoothstep(level, 0.03, 0.026) * smoothstep(level + point, -0.014, -0.01) * inside

    def scalp(self, p: np.ndarray) -> np.ndarray:
        """1 under the hair: behind a line from the forehead past the temples and ears to the nape."""
        y, back = p[:, 1] - self.face.eye[1], self.face.eye[2] - p[:, 2]
        line = 0.062 - 1.1 * np.clip(back - 0.022, 0, None)
        line = np.maximum(line, -0.085)
        ear = faces.blob((back - 0.088) / 0.03, (y + 0.02) / 0.035, 0.9) * (np.abs(p[:, 0]) > 0.06)
        return smoothstep(y - line, -0.006, 0.006) * (1 - ear) * (y > -0.11)


def look() -> assembly.AvatarMesh:
    """Shape, dress and paint her; about two seconds."""
    body = load_body()
    bare, rig = shape(body, _MACRO)
    joint = {name: rig.heads[rig.index(name)].astype(np.float64) for name in rig.names}
    eyes, eye, radius = faces.eyeballs(body, bare)
    face = faces.Face(
        eye=eye,
        radius=radius,
        skin=np.array([236.0, 190.0, 160.0]),
        brow=_HAIR * 0.5,
        lips=np.array([186.0, 84.0, 82.0]),
        iris=np.array([74.0, 122.0, 110.0]),
    )
    cut = _Cut(
        face=face,
        arm=limb(rig, "Arm", "ForeArm"),
        elbow=float(np.linalg.norm(joint["LeftForeArm"] - joint["LeftArm"])),
        neck=float(joint["Neck"][1]),
        waist=float(joint["Spine"][1]) + 0.025,
    )
    knee = float(joint["LeftLeg"][1])
    boot_top = 0.72 * knee

    whole = body_piece(body, bare, ("body",), "body")
    skin = body_piece(body, bare, ("body",), "body", keep=bare[:, 1] > boot_top - 0.03)
    skin = _thicken(skin, cut)
    head = skin.vertices[skin.weights[:, rig.index("Head")] > 0.6]
    boots = [footwear.boot(rig, s, whole.vertices, whole.weights, top=boot_top) for s in ("Left", "Right")]
    hat = headwear.hat(rig, head, base=float(face.eye[1]) + 0.058)
    braids = _braids(rig, skin, face, bottom=float(joint["Spine2"][1]) - 0.1)
    trunk = skin.vertices[share(rig, skin.weights, "Arm", "Hand", "Shoulder") < 0.3]
    skirt = skirts.skirt(rig, trunk, top=cut.waist, bottom=knee + 0.02, flare=0.3)
    belt = belts.bullet_belt(rig, skirt.vertices, left=cut.waist - 0.045, right=cut.waist - 0.1)
    # Where the belt lies on the skirt, it holds it.
    loose = 1.5 * np.clip(belt.vertices[:, 1].min() - 0.012 - skirt.vertices[:, 1], 0, None)
    skirt = dataclasses.replace(skirt, reach=loose.astype(np.float32))

    layers = [
        assembly.Layer(skin, (0.0, 0.0, 0.74, 0.74), lambda p, n, uv: _paint_body(cut, p)),
        assembly.Layer(braids[0], (0.74, 0.0, 0.82, 0.36), _paint_braid),
        assembly.Layer(braids[1], (0.82, 0.0, 0.9, 0.36), _paint_braid),
        assembly.Layer(belt, (0.88, 0.86, 1.0, 1.0), _paint_bullet_belt),
        assembly.Layer(eyes, (0.88, 0.74, 1.0, 0.86), lambda p, n, uv: faces.paint_eyes(face, p)),
        assembly.Layer(hat, (0.74, 0.36, 1.0, 0.74), _paint_hat),
        assembly.Layer(boots[0], (0.6, 0.74, 0.74, 1.0), _paint_boot),
        assembly.Layer(boots[1], (0.74, 0.74, 0.88, 1.0), _paint_boot),
        assembly.Layer(skirt, (0.0, 0.74, 0.6, 1.0), _paint_skirt),
    ]
    return assembly.assemble("cowgirl", rig, layers, sole=_SOLE)


def _thicken(skin: Piece, cut: _Cut) -> Piece:
    """The skin as a garment where she is dressed: smoother than a body, and a little outside it; fuller under the
    hair."""
    p = skin.vertices.astype(np.float64)
    dressed, scalp = cut.torso(p), cut.scalp(p)
    thick = 0.006 * dressed + 0.005 * cut.vest(p) + 0.008 * cut.bandana(p) + 0.014 * scalp
    return tailoring.let_out(skin, thick, 0.6 * dressed + 0.3 * scalp, 12)


def _braids(rig: Rig, skin: Piece, face: faces.Face, bottom: float) -> list[Piece]:
    """Two braids from behind the ears over the front of the shoulders down to about height `bottom`."""
    ground = Ground.of([skin])
    eye = face.eye
    neck = rig.heads[rig.index("Neck")]
    braids = []
    for name, side in (("left braid", 1.0), ("right braid", -1.0)):
        knots = np.array(
            [
                [0.05, eye[1] - 0.045, eye[2] - 0.13],
                [0.07, eye[1] - 0.085, eye[2] - 0.115],
                [0.088, neck[1] + 0.0, neck[2] + 0.045],
                [0.092, neck[1] - 0.09, neck[2] + 0.115],
                [0.086, 0.5 * (neck[1] - 0.09 + bottom), neck[2] + 0.15],
                [0.08, bottom, neck[2] + 0.15],
            ]
        )
        braids.append(hair.braid(rig, name, knots * np.array([side, 1, 1]), ground, width=0.023))
    return braids


def _paint_body(cut: _Cut, p: np.ndarray) -> np.ndarray:
    colour = faces.paint_skin(cut.face, p)
    strands = noise(p * np.array([1, 0.25, 1]), 0.004, 3)
    colour = mix(colour, _HAIR * (0.9 + 0.16 * strands)[:, None], cut.scalp(p))
    shirt = np.broadcast_to(_SHIRT, p.shape) * (1 + 0.03 * noise(p, 0.012, 1))[:, None]
    along = cut.sleeve(p)
    cuff = smoothstep(along, cut.elbow + 0.002, cut.elbow + 0.006)
    shirt = mix(shirt, _SHIRT * 0.84, 0.8 * cuff)
    # The placket and its buttons.
    front = p[:, 2] > 0.03
    shirt = mix(shirt, _SHIRT * 0.8, 0.7 * front * smoothstep(np.abs(np.abs(p[:, 0]) - 0.013), 0.0018, 0.001))
    button = np.hypot(p[:, 0], (p[:, 1] - cut.waist) % 0.045 - 0.0225)
    shirt = mix(shirt, _BRASS, front * smoothstep(button, 0.0055, 0.004))
    colour = mix(colour, shirt, cut.torso(p))
    leather = np.broadcast_to(_VEST, p.shape) * (1 + 0.1 * noise(p, 0.02, 2) + 0.05 * noise(p, 0.006, 4))[:, None]
    vest = cut.vest(p)
    inner = cut.vest(p + np.sign(p) * np.array([-0.009, 0, 0])) * cut.vest(p + np.sign(p) * np.array([0.009, 0, 0]))
    leather = mix(leather, _VEST * 0.55, 0.8 * (1 - inner))
    pocket = np.maximum(np.abs(np.abs(p[:, 0]) - 0.085) / 0.03, np.abs(p[:, 1] - cut.waist - 0.075) / 0.022)
    leather = mix(leather, _VEST * 0.6, 0.8 * front * smoothstep(np.abs(pocket - 0.95), 0.09, 0.04))
    colour = mix(colour, leather, vest)
    scarf = _BANDANA * (1 + 0.12 * noise(p, 0.015, 5))[:, None]
    dots = np.hypot((p[:, 0] + 0.006) % 0.012 - 0.006, p[:, 1] % 0.012 - 0.006)
    scarf = mix(scarf, np.array([244.0, 232, 220]), 0.9 * smoothstep(dots, 0.0024, 0.0016))
    return mix(colour, scarf, cut.bandana(p))


def _paint_skirt(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    weave = 0.05 * noise(p * np.array([1, 0.3, 1]), 0.006, 6) + 0.05 * noise(p, 0.05, 7)
    folds = 0.10 * np.cos(11 * 2 * np.pi * uv[:, 0]) * (1 - uv[:, 1])
    colour = _DENIM * (1 + weave + folds)[:, None]
    # Seams down the gores, then the hem: a cream band between two red lines.
    seam = np.abs((uv[:, 0] * 6 + 0.5) % 1 - 0.5)
    colour = mix(colour, np.array([206.0, 158, 86]), 0.7 * smoothstep(seam, 0.013, 0.007) * (uv[:, 1] < 0.9))
    v = uv[:, 1]
    colour = mix(colour, _BANDANA, smoothstep(np.abs(v - 0.128), 0.014, 0.011))
    colour = mix(colour, _HEM, smoothstep(v, 0.095, 0.088))
    zigzag = np.abs((uv[:, 0] * 33) % 1 - 0.5) * 0.09 + 0.022
    colour = mix(colour, _BANDANA, smoothstep(np.abs(v - zigzag), 0.012, 0.008) * (v < 0.09))
    belt = smoothstep(v, 0.918, 0.924)
    colour = mix(colour, _BELT * (1 + 0.1 * noise(p, 0.01, 8))[:, None], belt)
    buckle = np.maximum(np.abs(p[:, 0]) / 0.026, np.abs(v - 0.962) / 0.036)
    ahead = p[:, 2] > 0
    colour = mix(colour, _BRASS, ahead * smoothstep(buckle, 1.0, 0.93))
    return mix(colour, _BRASS * 0.6, ahead * smoothstep(np.abs(buckle - 0.6), 0.12, 0.06))


def _paint_braid(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    return hair.paint_braid(uv, _HAIR, _BANDANA)


def _paint_bullet_belt(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    u, v = uv[:, 0], uv[:, 1]
    band = patterns.leather(p, _BELT * 1.25, 15)
    buckle = np.minimum(u, 1 - u)
    band = mix(band, _BRASS, smoothstep(buckle, 0.026, 0.023))
    band = mix(band, _BRASS * 0.6, smoothstep(np.abs(buckle - 0.014), 0.004, 0.002))
    # Along a cartridge: the rim of its case, the brass, and the lead of the bullet.
    height = v / 0.48
    brass = _BRASS * np.array([1.08, 1.04, 0.92]) * (1 + 0.12 * np.cos(2 * np.pi * 34 * u))[:, None]
    case = mix(brass, _BRASS * 0.55, smoothstep(np.abs(height - 0.22), 0.06, 0.02))
    case = mix(case, np.array([186.0, 120.0, 84.0]), smoothstep(height, 0.58, 0.62))
    return mix(case, band, smoothstep(v, 0.49, 0.495))


def _paint_hat(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = _FELT * (1 + 0.06 * noise(p, 0.02, 11) + 0.03 * noise(p, 0.005, 12))[:, None]
    v = uv[:, 1]
    rows = 14.0
    band = smoothstep(v, 1 - 5.95 / rows, 1 - 6.05 / rows) * smoothstep(v, 1 - 7.6 / rows, 1 - 7.5 / rows)
    colour = mix(colour, _BELT, band)
    colour = mix(colour, _BELT * 1.2, smoothstep(v, 0.955, 0.965))
    return mix(colour, _FELT * 0.75, 0.5 * smoothstep(v, 0.3, 0.05))


def _paint_boot(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = _BOOT * (1 + 0.12 * noise(p, 0.03, 13) + 0.05 * noise(p, 0.008, 14))[:, None]
    v = uv[:, 1]
    colour = mix(colour, _BOOT * 1.5, smoothstep(v, 0.955, 0.965))
    stitch = np.abs(v - 0.8 + 0.08 * np.cos(2 * np.pi * uv[:, 0] * 2))
    colour = mix(colour, _HEM, 0.8 * smoothstep(stitch, 0.012, 0.008))
    colour = mix(colour, _BOOT * 0.72, smoothstep(v, 0.26, 0.2))
    return mix(colour, np.array([44.0, 28, 20]), smoothstep(p[:, 1], 0.008, 0.004))
