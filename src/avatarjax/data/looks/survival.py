"""The survivor: a man with stubble in a jacket and cargo trousers, hiking boots, a long open coat and a backpack."""

from __future__ import annotations

import dataclasses

import numpy as np

from avatarjax.data.body import Rig, load_body, shape
from avatarjax.data.wardrobe import assembly, backpacks, coats, faces, footwear, patterns, skirts, tailoring
from avatarjax.data.wardrobe.bones import Limb, limb, share
from avatarjax.data.wardrobe.garments import Piece, smoothstep
from avatarjax.data.wardrobe.skin import body_piece
from avatarjax.data.wardrobe.textures import mix, noise

_MACRO = {
    "caucasian-male-young": 0.75,
    "caucasian-male-old": 0.25,
    "universal-male-young-maxmuscle-averageweight": 0.5,
}
_COAT = np.array([186.0, 150.0, 104.0])
_JACKET = np.array([124.0, 122.0, 78.0])
_SHIRT = np.array([214.0, 210.0, 200.0])
_TROUSERS = np.array([124.0, 124.0, 118.0])
_LEATHER = np.array([96.0, 62.0, 40.0])
_BOOT = np.array([128.0, 88.0, 52.0])
_PACK = np.array([70.0, 92.0, 108.0])
_ROLL = np.array([204.0, 96.0, 52.0])
_STEEL = np.array([196.0, 198.0, 200.0])
_HAIR = np.array([84.0, 60.0, 42.0])
_GLOVE = np.array([74.0, 58.0, 46.0])
_SOLE = 0.012


@dataclasses.dataclass(frozen=True, eq=False)
class _Cut:
    """Where his clothes end, metres in the rest pose."""

    face: faces.Face
    waist: float
    neck: float
    hip: float
    knee: float
    wrist: Limb
    legs: tuple[np.ndarray, np.ndarray]

    def hand(self, p: np.ndarray) -> np.ndarray:
        """Metres past the wrist along the forearm; negative before it and off the arms."""
        return self.wrist.along(p)

    def on_arm(self, p: np.ndarray) -> np.ndarray:
        """Whether a point is of the forearm or the hand: no other part is as far out."""
        return (np.abs(p[:, 0]) > 0.3) & (p[:, 1] > 0.8)

    def trousers(self, p: np.ndarray) -> np.ndarray:
        """1 from the waist down."""
        return smoothstep(p[:, 1], self.waist + 0.006, self.waist) * ~self.on_arm(p)

    def collar(self, p: np.ndarray) -> np.ndarray:
        """Metres above the jacket's neckline, which is low in front."""
        return p[:, 1] - self.neck + 0.03 + 0.42 * np.clip(p[:, 2] - 0.0, -0.02, 0.075)

    def jacket(self, p: np.ndarray) -> np.ndarray:
        """1 above the waist, below the neckline and beside the open front, through which the shirt shows."""
        level = self.collar(p)
        opening = 0.012 + 0.42 * np.clip(p[:, 1] - (self.waist + 0.13), 0, None)
        wide = smoothstep(np.abs(p[:, 0]), opening - 0.003, opening + 0.003)
        front = np.where(p[:, 2] > 0.03, wide, 1.0)
        return smoothstep(level, 0.045, 0.035) * front * smoothstep(p[:, 1], self.waist, self.waist + 0.006)

    def dressed(self, p: np.ndarray) -> np.ndarray:
        """1 under any cloth that lies on the skin."""
        return smoothstep(self.collar(p), 0.03, 0.02) * ~self.on_arm(p)

    def pocket(self, p: np.ndarray) -> np.ndarray:
        """In units of its half size, how far from the middle of a cargo pocket on the outside of the thigh."""
        leg = self.legs
        t = np.clip((leg[0][1] - p[:, 1]) / (leg[0][1] - leg[1][1]), 0, 1)
        axis = leg[0] + t[:, None] * (leg[1] - leg[0])
        turn = np.arctan2(p[:, 2] - axis[:, 2], np.abs(p[:, 0]) - axis[:, 0])
        along = np.abs(p[:, 1] - 0.5 * self.hip - 0.5 * self.knee + 0.03) / 0.085
        return np.maximum(np.abs(turn - 0.1) / 0.75, along)

    def scalp(self, p: np.ndarray) -> np.ndarray:
        """1 under short hair: behind a line from the forehead past the temples and ears to the nape."""
        y, back = p[:, 1] - self.face.eye[1], self.face.eye[2] - p[:, 2]
        x = np.abs(p[:, 0])
        line = 0.066 - 0.01 * smoothstep(x, 0.025, 0.045) - 2.4 * np.clip(back - 0.034, 0, None)
        # The sideburn runs down before the ear.
        line = np.maximum(line, np.where(back < 0.095, -0.012, -0.075))
        ear = faces.blob((back - 0.098) / 0.03, (y + 0.012) / 0.036, 0.9) * (x > 0.068)
        return smoothstep(y - line, -0.005, 0.005) * (1 - ear) * (y > -0.1)

    def glove(self, p: np.ndarray) -> np.ndarray:
        """1 on the palm and back of the hand, up to the first joints of the fingers."""
        along = self.hand(p)
        return smoothstep(along, -0.004, 0.0) * smoothstep(along, 0.108, 0.104) * self.on_arm(p)


def look() -> assembly.AvatarMesh:
    """Shape, dress and paint him; about two seconds."""
    body = load_body()
    bare, rig = shape(body, _MACRO)
    joint = {name: rig.heads[rig.index(name)].astype(np.float64) for name in rig.names}
    eyes, eye, radius = faces.eyeballs(body, bare)
    face = faces.Face(
        eye=eye,
        radius=radius,
        skin=np.array([226.0, 178.0, 146.0]),
        brow=_HAIR * 0.75,
        lips=np.array([186.0, 116.0, 100.0]),
        iris=np.array([92.0, 120.0, 140.0]),
        mouth=-0.0705,
        lash=0.6,
        heavy=1.6,
    )
    cut = _Cut(
        face=face,
        waist=float(joint["Spine"][1]) - 0.03,
        neck=float(joint["Neck"][1]),
        hip=float(joint["LeftUpLeg"][1]),
        knee=float(joint["LeftLeg"][1]),
        wrist=limb(rig, "ForeArm", "Hand", "Hand"),
        legs=(joint["LeftUpLeg"], joint["LeftLeg"]),
    )
    boot_top = 0.58 * cut.knee

    whole = body_piece(body, bare, ("body",), "body")
    shell = body_piece(body, bare, ("helper-tights",), "coat")
    skin = _thicken(body_piece(body, bare, ("body",), "body", keep=_seen(cut, bare, boot_top)), cut)
    boots = [
        footwear.boot(rig, s, whole.vertices, whole.weights, top=boot_top, margin=0.012) for s in ("Left", "Right")
    ]
    top = coats.coat_top(rig, shell, waist=cut.waist - 0.01, neck=cut.neck - 0.02)
    trunk = top.vertices[share(rig, top.weights, "Arm", "Hand") < 0.3]
    legs = skin.vertices[share(rig, skin.weights, "Arm", "Hand") < 0.3]
    under = np.concatenate([trunk, legs[legs[:, 1] < cut.waist + 0.03]])
    skirt = skirts.coat_skirt(rig, under, top, start=cut.waist + 0.025, waist=cut.waist - 0.015, bottom=0.62 * cut.knee)
    collar = coats.collar(rig, whole.vertices, top, base=cut.neck - 0.012)
    back = float(trunk[np.abs(trunk[:, 1] - joint["Spine2"][1]) < 0.12, 2].min())
    centre = np.array([0.0, float(joint["Spine2"][1]) - 0.035, back - 0.09])
    pack = backpacks.backpack(rig, top, centre=centre)

    layers = [
        assembly.Layer(skin, (0.0, 0.0, 0.6, 0.6), lambda p, n, uv: _paint_body(cut, p)),
        assembly.Layer(eyes, (0.9, 0.6, 1.0, 0.7), lambda p, n, uv: faces.paint_eyes(face, p)),
        assembly.Layer(top, (0.6, 0.0, 1.0, 0.6), lambda p, n, uv: _paint_coat(cut, rig, p)),
        assembly.Layer(collar, (0.6, 0.6, 0.9, 0.7), lambda p, n, uv: _paint_collar(p, uv)),
        assembly.Layer(skirt, (0.0, 0.6, 0.4, 1.0), lambda p, n, uv: _paint_coat_skirt(p, uv)),
        assembly.Layer(pack, (0.4, 0.7, 0.78, 1.0), _paint_pack),
        assembly.Layer(boots[0], (0.78, 0.7, 0.89, 1.0), _paint_boot),
        assembly.Layer(boots[1], (0.89, 0.7, 1.0, 1.0), _paint_boot),
    ]
    return assembly.assemble("survival", rig, layers, sole=_SOLE)


def _seen(cut: _Cut, p: np.ndarray, boot_top: float) -> np.ndarray:
    """The skin (v,) that coat and boots leave to be seen."""
    front = (np.abs(p[:, 0]) < 0.15) & (p[:, 2] > 0.02) & (p[:, 1] > cut.waist)
    neck = (p[:, 1] > cut.neck - 0.06) & (np.abs(p[:, 0]) < 0.13)
    low = (p[:, 1] < cut.waist + 0.05) & (p[:, 1] > boot_top - 0.1) & ~cut.on_arm(p)
    hand = cut.on_arm(p) & (cut.hand(p) > -0.05)
    return ((front | neck) & ~cut.on_arm(p)) | low | hand


def _thicken(skin: Piece, cut: _Cut) -> Piece:
    """The skin as his clothes where he is dressed, and fuller under the hair."""
    p = skin.vertices.astype(np.float64)
    dressed, scalp, trousers = cut.dressed(p), cut.scalp(p), cut.trousers(p)
    pocket = smoothstep(cut.pocket(p), 1.05, 0.9) * trousers
    # Trousers are wider below the knee, where they bag over the boots, and crumple there.
    bag = smoothstep(p[:, 1], cut.knee + 0.1, 0.6 * cut.knee)
    crumple = bag * noise(p, 0.05, 21) + 0.4 * noise(p, 0.09, 22)
    cloth = 0.006 * dressed + 0.006 * cut.jacket(p)
    loose = smoothstep(cut.hip - p[:, 1], 0.0, 0.15)
    legs = 0.011 + 0.008 * loose + 0.008 * bag + 0.006 * crumple * loose + 0.014 * pocket
    cloth = np.where(trousers > 0.5, legs, cloth)
    hair = scalp * (0.011 + 0.004 * noise(p, 0.016, 23))
    thick = cloth + hair + 0.002 * cut.glove(p)
    return tailoring.let_out(skin, thick, 0.6 * dressed + 0.2 * scalp, 10)


def _paint_body(cut: _Cut, p: np.ndarray) -> np.ndarray:
    face = cut.face
    colour = faces.paint_stubble(face, faces.paint_skin(face, p), p, 0.42)
    strands = 0.14 * noise(p * np.array([1, 1, 0.3]), 0.004, 3) + 0.16 * noise(p, 0.012, 4)
    colour = mix(colour, _HAIR * (1 + strands)[:, None], cut.scalp(p))
    shirt = _SHIRT * (1 + 0.03 * noise(p, 0.01, 1))[:, None]
    shirt = mix(shirt, _SHIRT * 0.8, 0.7 * smoothstep(np.abs(cut.collar(p) - 0.012), 0.012, 0.008))
    colour = mix(colour, shirt, cut.dressed(p))
    front = p[:, 2] > 0.03
    jacket = patterns.canvas(p, _JACKET, 24)
    opening = 0.012 + 0.42 * np.clip(p[:, 1] - (cut.waist + 0.13), 0, None)
    away = np.abs(p[:, 0]) - opening
    jacket = mix(jacket, _JACKET * 0.62, front * smoothstep(away, 0.006, 0.003))
    jacket = mix(jacket, _JACKET * 1.35, 0.8 * front * patterns.stitches(away - 0.012, p[:, 1]))
    zip_ = front * smoothstep(np.abs(p[:, 0]), 0.004, 0.003) * (p[:, 1] < cut.waist + 0.13)
    flap = np.maximum(np.abs(np.abs(p[:, 0]) - 0.09) / 0.035, np.abs(p[:, 1] - cut.waist - 0.24) / 0.03)
    jacket = mix(jacket, _JACKET * 0.6, 0.8 * front * smoothstep(np.abs(flap - 0.95), 0.09, 0.04))
    colour = mix(colour, jacket, cut.jacket(p))
    colour = mix(colour, _STEEL * (0.75 + 0.25 * (p[:, 1] % 0.008 < 0.004))[:, None], zip_ * cut.dressed(p))
    colour = mix(colour, _trousers(cut, p), cut.trousers(p))
    glove = patterns.leather(p, _GLOVE, 26)
    return mix(colour, glove, cut.glove(p))


def _trousers(cut: _Cut, p: np.ndarray) -> np.ndarray:
    colour = patterns.canvas(p, _TROUSERS, 27)
    x = np.abs(p[:, 0])
    # Seams: along the outside of the leg, a patch over the knee, the pocket with its flap and button.
    t = np.clip((cut.legs[0][1] - p[:, 1]) / (cut.legs[0][1] - cut.legs[1][1]), 0, 1.8)
    axis = cut.legs[0] + t[:, None] * (cut.legs[1] - cut.legs[0])
    turn = np.arctan2(p[:, 2] - axis[:, 2], x - axis[:, 0])
    colour = mix(colour, _TROUSERS * 0.68, 0.8 * smoothstep(np.abs(turn + 0.1), 0.05, 0.03))
    knee = np.maximum(np.abs(turn - 1.45) / 0.85, np.abs(p[:, 1] - cut.knee - 0.01) / 0.085)
    colour = mix(colour, _TROUSERS * 0.86, smoothstep(knee, 1.02, 0.98))
    colour = mix(colour, _TROUSERS * 0.6, 0.8 * smoothstep(np.abs(knee - 1), 0.045, 0.025))
    pocket = cut.pocket(p)
    middle = 0.5 * (cut.hip + cut.knee) - 0.03
    colour = mix(colour, _TROUSERS * 1.1, smoothstep(pocket, 1.02, 0.98))
    colour = mix(colour, _TROUSERS * 0.55, 0.9 * smoothstep(np.abs(pocket - 1), 0.06, 0.035))
    inside = smoothstep(pocket, 1.0, 0.97)
    colour = mix(colour, _TROUSERS * 0.55, 0.9 * inside * smoothstep(np.abs(p[:, 1] - middle - 0.035), 0.005, 0.003))
    button = np.hypot((turn - 0.1) * 0.09, p[:, 1] - middle - 0.05)
    colour = mix(colour, _LEATHER, inside * smoothstep(button, 0.009, 0.007))
    belt = smoothstep(p[:, 1], cut.waist - 0.04, cut.waist - 0.036)
    colour = mix(colour, patterns.leather(p, _LEATHER, 28), belt)
    buckle = np.maximum(x / 0.028, np.abs(p[:, 1] - cut.waist + 0.018) / 0.02)
    front = p[:, 2] > 0.03
    colour = mix(colour, _STEEL, front * smoothstep(buckle, 1.0, 0.92))
    colour = mix(colour, _LEATHER, front * smoothstep(buckle, 0.68, 0.6))
    fly = smoothstep(np.abs(x - 0.0), 0.003, 0.0015) * (p[:, 1] > cut.waist - 0.17) * front
    return mix(colour, _TROUSERS * 0.6, 0.8 * fly)


def _paint_coat(cut: _Cut, rig: Rig, p: np.ndarray) -> np.ndarray:
    colour = patterns.leather(p, _COAT, 29)
    x = np.abs(p[:, 0])
    edge = 0.085
    lapel_edge = edge + 0.055 + 0.25 * np.clip(p[:, 1] - (cut.neck - 0.16), -0.2, 0)
    front = p[:, 2] > 0.02
    lapel = front * smoothstep(x, lapel_edge, lapel_edge - 0.004) * (p[:, 1] > cut.waist + 0.1)
    colour = mix(colour, _COAT * 0.86, lapel)
    rim = front * smoothstep(np.abs(x - lapel_edge), 0.006, 0.003) * (p[:, 1] > cut.waist + 0.1) * (x < 0.15)
    colour = mix(colour, _COAT * 0.55, 0.85 * rim)
    before = coats.sleeve_end(rig, p, 0.012)
    cuff = smoothstep(before, 0.07, 0.066) * (x > 0.3)
    colour = mix(colour, _COAT * 0.8, cuff)
    colour = mix(colour, _COAT * 0.5, 0.8 * (x > 0.3) * smoothstep(np.abs(before - 0.068), 0.005, 0.003))
    # The seam around the shoulder and the yoke over the back.
    shoulder = rig.heads[rig.index("LeftArm")]
    armhole = x - shoulder[0] - 0.012 - 0.45 * np.clip(shoulder[1] - p[:, 1], -0.1, 0.12)
    colour = mix(colour, _COAT * 0.6, 0.7 * smoothstep(np.abs(armhole), 0.008, 0.002) * (p[:, 1] > cut.waist + 0.2))
    yoke = p[:, 1] - (cut.neck - 0.16) - 0.1 * x
    colour = mix(colour, _COAT * 0.6, 0.7 * ~front * smoothstep(np.abs(yoke), 0.008, 0.002) * (x < 0.2))
    return mix(colour, _LEATHER, smoothstep(p[:, 1], cut.waist + 0.03, cut.waist + 0.027) * (x < 0.3))


def _paint_collar(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.leather(p, _COAT * 0.86, 30)
    edge = np.minimum(np.minimum(uv[:, 0], 1 - uv[:, 0]) * 8, uv[:, 1] * 1.6)
    return mix(colour, _COAT * 0.55, 0.8 * smoothstep(np.abs(edge - 0.12), 0.06, 0.03))


def _paint_coat_skirt(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    u, v = uv[:, 0], uv[:, 1]
    folds = 0.06 * np.cos(9 * 2 * np.pi * u) * (1 - v)
    colour = patterns.leather(p, _COAT, 29) * (1 + folds)[:, None]
    colour = mix(colour, _COAT * 0.62, 0.7 * smoothstep(np.abs(u - 0.5), 0.004, 0.002))
    edge = np.minimum(u, 1 - u)
    colour = mix(colour, _COAT * 0.62, 0.8 * smoothstep(np.abs(edge - 0.016), 0.003, 0.0015))
    colour = mix(colour, _COAT * 0.62, 0.8 * smoothstep(np.abs(v - 0.035), 0.006, 0.003))
    colour = mix(colour, _COAT * 0.78, smoothstep(v, 0.012, 0.006))
    # Pockets with flaps on the hips.
    flap = np.maximum(np.abs(np.abs(u - 0.5) - 0.3) / 0.06, np.abs(v - 0.78) / 0.03)
    bag = np.maximum(np.abs(np.abs(u - 0.5) - 0.3) / 0.055, np.abs(v - 0.69) / 0.1)
    colour = mix(colour, _COAT * 0.6, 0.6 * smoothstep(np.abs(bag - 1), 0.05, 0.03))
    colour = mix(colour, _COAT * 0.9, smoothstep(flap, 1.02, 0.98))
    colour = mix(colour, _COAT * 0.5, 0.85 * smoothstep(np.abs(flap - 1), 0.1, 0.05))
    # The belt over the seam to the upper part.
    belt = smoothstep(v, 0.945, 0.95)
    colour = mix(colour, patterns.leather(p, _LEATHER, 28), belt)
    loops = smoothstep(np.abs((u * 8) % 1 - 0.5), 0.07, 0.06) * belt
    return mix(colour, _COAT * 0.8, loops)


def _paint_pack(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    u, v = uv[:, 0], uv[:, 1]
    colour = patterns.canvas(p, _PACK, 31)
    strap = np.abs(np.abs(p[:, 0]) - 0.075)
    webbing = patterns.canvas(p, _LEATHER * 1.15, 32)
    bag = (v > 0.4) & ((u < 0.6) | (v > 0.7))
    colour = mix(colour, webbing, bag * smoothstep(strap, 0.014, 0.012))
    colour = mix(colour, _STEEL, bag * smoothstep(np.maximum(strap / 0.018, np.abs(v - 0.82) / 0.014), 1.0, 0.9))
    lid = (u > 0.6) & (v > 0.7)
    colour = mix(colour, colour * 0.85, lid * 1.0)
    pockets = (v > 0.1) & (v < 0.4) & (u < 0.6)
    colour = mix(colour, colour * 1.12, pockets * 1.0)
    colour = mix(colour, _PACK * 0.5, pockets * 0.9 * smoothstep(np.abs(v - 0.31), 0.007, 0.004))
    rolled = (u > 0.6) & (v > 0.3) & (v <= 0.7)
    along = (v - 0.3) / 0.4
    blanket = _ROLL * (1 + 0.06 * noise(p, 0.02, 33) + 0.05 * noise(p, 0.006, 34))[:, None]
    ring = np.sin(2 * np.pi * np.hypot(p[:, 1] - p[:, 1].max() + 0.064, p[:, 2]) / 0.012)
    blanket = mix(blanket, _ROLL * 0.65, 0.6 * (np.minimum(along, 1 - along) < 0.14) * (ring > 0.2))
    tie = smoothstep(np.abs(np.abs(p[:, 0]) - 0.13), 0.014, 0.011)
    colour = mix(colour, mix(blanket, _LEATHER * 1.2, tie), rolled * 1.0)
    straps = (u > 0.6) & (v <= 0.3)
    return mix(colour, mix(webbing, _LEATHER * 0.8, 0.8 * smoothstep(np.abs(u % 0.2 - 0.1), 0.05, 0.06)), straps * 1.0)


def _paint_boot(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    colour = patterns.leather(p, _BOOT, 35)
    v = uv[:, 1]
    colour = mix(colour, _LEATHER * 0.8, smoothstep(v, 0.94, 0.95))
    # Laces cross over the instep; they face forward and up.
    front = smoothstep(n[:, 2], 0.45, 0.6) * (p[:, 1] > 0.075) * (v < 0.94)
    colour = mix(colour, _LEATHER, front)
    rung = np.abs((p[:, 1] % 0.024) / 0.024 - 0.5)
    colour = mix(colour, np.array([226.0, 210, 170]), front * smoothstep(rung, 0.16, 0.1))
    colour = mix(colour, _BOOT * 0.7, smoothstep(p[:, 1], 0.05, 0.04))
    return mix(colour, np.array([58.0, 50, 46]), smoothstep(p[:, 1], 0.02, 0.014))
