"""The berserker: a huge man with war paint on his bare chest, a tartan kilt, a fur-collared cape, a full red beard and
wild hair, fur boots and leather bracers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from avatarjax.data.body import Rig, load_body, shape
from avatarjax.data.wardrobe import assembly, capes, faces, footwear, hair, patterns, skirts, tailoring
from avatarjax.data.wardrobe.bones import Limb, limb, share
from avatarjax.data.wardrobe.garments import Piece, smoothstep
from avatarjax.data.wardrobe.ground import Ground
from avatarjax.data.wardrobe.skin import body_piece, relief
from avatarjax.data.wardrobe.textures import mix, noise

_MACRO = {"caucasian-male-young": 1.0, "universal-male-young-maxmuscle-averageweight": 2.4}
_SKIN = np.array([224.0, 172.0, 138.0])
_HAIR = np.array([186.0, 92.0, 40.0])
_WOAD = np.array([44.0, 84.0, 150.0])
_TARTAN = np.array([166.0, 44.0, 38.0])
_BAND = np.array([38.0, 76.0, 60.0])
_LINE = np.array([236.0, 206.0, 110.0])
_LEATHER = np.array([104.0, 66.0, 40.0])
_CAPE = np.array([112.0, 130.0, 158.0])
_FUR_DARK = np.array([96.0, 78.0, 62.0])
_FUR_LIGHT = np.array([212.0, 194.0, 166.0])
_BRASS = np.array([218.0, 180.0, 96.0])
_STEEL = np.array([200.0, 202.0, 204.0])
_SOLE = 0.012


@dataclasses.dataclass(frozen=True, eq=False)
class _Cut:
    """Where leather, paint and hair are on him, metres in the rest pose."""

    face: faces.Face
    waist: float
    chest: np.ndarray
    arm: Limb

    def strap(self, p: np.ndarray) -> np.ndarray:
        """Metres from the middle of the baldric, which runs from the left shoulder to the right hip and around."""
        down = np.array([-0.62, -0.78])
        across = np.array([down[1], -down[0]])
        offset = np.stack([p[:, 0], p[:, 1]], axis=1) - self.chest[:2]
        return np.abs(offset @ across)

    def harness(self, p: np.ndarray) -> np.ndarray:
        """1 on the baldric, on the trunk."""
        trunk = (p[:, 1] > self.waist - 0.05) & (p[:, 1] < self.arm.joint[1] + 0.08) & (np.abs(p[:, 0]) < 0.23)
        arm = (p[:, 0] > self.arm.joint[0] - 0.02) & (p[:, 1] < self.arm.joint[1] - 0.02)
        return smoothstep(self.strap(p), 0.03, 0.028) * trunk * ~arm

    def scalp(self, p: np.ndarray) -> np.ndarray:
        """1 under the hair: behind a line from the forehead past the temples and ears to the nape."""
        y, back = p[:, 1] - self.face.eye[1], self.face.eye[2] - p[:, 2]
        x = np.abs(p[:, 0])
        line = 0.066 - 0.008 * smoothstep(x, 0.03, 0.05) - 2.2 * np.clip(back - 0.036, 0, None)
        line = np.maximum(line, np.where(back < 0.1, -0.05, -0.09))
        ear = faces.blob((back - 0.1) / 0.028, (y + 0.012) / 0.034, 0.9) * (x > 0.068)
        return smoothstep(y - line, -0.005, 0.005) * (1 - ear) * (y > -0.1)


def look() -> assembly.AvatarMesh:
    """Shape, dress and paint him; about two seconds."""
    body = load_body()
    bare, rig = shape(body, _MACRO)
    joint = {name: rig.heads[rig.index(name)].astype(np.float64) for name in rig.names}
    eyes, eye, radius = faces.eyeballs(body, bare)
    face = faces.Face(
        eye=eye,
        radius=radius,
        skin=_SKIN,
        brow=_HAIR * 0.7,
        lips=np.array([180.0, 104.0, 90.0]),
        iris=np.array([96.0, 140.0, 170.0]),
        mouth=-0.0705,
        lash=0.7,
        heavy=2.0,
    )
    waist, knee = float(joint["Spine"][1]) - 0.02, float(joint["LeftLeg"][1])
    cut = _Cut(
        face=face,
        waist=waist,
        chest=np.array([0.02, 0.5 * (joint["Spine2"][1] + joint["LeftArm"][1]) - 0.03, 0.1]),
        arm=limb(rig, "Arm", "ForeArm"),
    )
    boot_top = 0.66 * knee

    whole = body_piece(body, bare, ("body",), "body")
    shell = body_piece(body, bare, ("helper-tights",), "shell")
    skin = body_piece(body, bare, ("body",), "body", keep=bare[:, 1] > boot_top - 0.08)
    hollow = relief(skin.vertices, skin.faces, 30)
    skin = _thicken(skin, cut)
    trunk = skin.vertices[share(rig, skin.weights, "Arm", "Hand") < 0.3]
    boots = []
    for side in ("Left", "Right"):
        boot = footwear.boot(rig, side, whole.vertices, whole.weights, top=boot_top, margin=0.014, columns=26)
        high = smoothstep(boot.vertices[:, 1], 0.07, 0.13)
        boots.append(capes.furry(boot, 0.016 * high, tuft=0.012))
    bracers = [_bracer(rig, shell, side) for side in (1.0, -1.0)]
    collar = capes.fur_collar(rig, shell, low=float(joint["Spine2"][1]) + 0.075)
    kilt = skirts.kilt(rig, trunk, top=waist + 0.015, bottom=knee + 0.03)
    cape = capes.cape(
        rig, [skin, kilt], top=cut.arm.joint[1] + 0.01, free=float(joint["Spine2"][1]) + 0.04, bottom=0.62 * knee
    )
    chin = whole.vertices[whole.weights[:, rig.index("Head")] > 0.6]
    low = chin[(np.abs(chin[:, 0]) < 0.01) & (chin[:, 1] < face.eye[1] + face.mouth - 0.02)]
    chin = low[np.argmax(low[:, 2])].astype(np.float64)
    beard = hair.full_beard(
        rig,
        Ground.of([skin]),
        chin,
        jaw=float(face.eye[1]) - 0.088,
        bottom=float(joint["Spine2"][1]) + 0.01,
        width=0.075,
    )
    locks = _wild_hair(rig, cut, skin, collar, bottom=float(joint["LeftArm"][1]) - 0.01)

    layers = [
        assembly.Layer(skin, (0.0, 0.0, 0.62, 0.62), lambda p, n, uv: _paint_body(cut, hollow, p)),
        assembly.Layer(eyes, (0.92, 0.0, 1.0, 0.08), lambda p, n, uv: faces.paint_eyes(face, p)),
        assembly.Layer(kilt, (0.0, 0.62, 0.62, 1.0), lambda p, n, uv: _paint_kilt(p, uv)),
        assembly.Layer(cape, (0.62, 0.56, 1.0, 1.0), lambda p, n, uv: _paint_cape(p, uv)),
        assembly.Layer(collar, (0.62, 0.26, 0.92, 0.56), lambda p, n, uv: patterns.fur(p, _FUR_DARK, _FUR_LIGHT)),
        assembly.Layer(locks, (0.62, 0.0, 0.77, 0.26), _paint_hair),
        assembly.Layer(beard, (0.77, 0.0, 0.92, 0.26), _paint_hair),
        assembly.Layer(bracers[0], (0.92, 0.08, 1.0, 0.17), lambda p, n, uv: _paint_bracer(rig, p)),
        assembly.Layer(bracers[1], (0.92, 0.17, 1.0, 0.26), lambda p, n, uv: _paint_bracer(rig, p)),
        assembly.Layer(boots[0], (0.92, 0.26, 1.0, 0.41), _paint_boot),
        assembly.Layer(boots[1], (0.92, 0.41, 1.0, 0.56), _paint_boot),
    ]
    return assembly.assemble("berserker", rig, layers, sole=_SOLE)


def _wild_hair(rig: Rig, cut: _Cut, skin: Piece, collar: Piece, bottom: float) -> Piece:
    """Two rows of locks from the sides and the back of the head down to the fur."""
    normals = assembly.vertex_normals(skin.vertices, skin.faces)
    eye = cut.face.eye
    head = np.flatnonzero(
        (skin.weights[:, rig.index("Head")] > 0.6) & (cut.scalp(skin.vertices.astype(np.float64)) > 0.9)
    )
    middle = np.array([0.0, 0.0, eye[2] - 0.095])
    places = skin.vertices[head] - middle
    chosen = []
    for height, turns in ((0.0, np.linspace(-0.9, 0.9, 7)), (0.055, np.linspace(-1.0, 1.0, 8))):
        for turn in turns:
            away = np.arctan2(places[:, 0], -places[:, 2]) - turn
            chosen.append(head[np.argmin(np.abs(away) * 0.09 + np.abs(places[:, 1] - eye[1] - height))])
    chosen = np.array(chosen)
    behind = float(collar.vertices[:, 2].min())
    return hair.locks(
        rig, skin.vertices[chosen], normals[chosen], Ground.of([skin, collar]), bottom=bottom, behind=behind
    )


def _bracer(rig: Rig, shell: Piece, side: float) -> Piece:
    """A leather cuff about a forearm, from the wrist two thirds up to the elbow."""
    wrist = rig.heads[rig.index("LeftHand")].astype(np.float64) * np.array([side, 1, 1])
    elbow = rig.heads[rig.index("LeftForeArm")].astype(np.float64) * np.array([side, 1, 1])
    length = np.linalg.norm(elbow - wrist)
    p = shell.vertices.astype(np.float64)
    along = (p - wrist) @ (elbow - wrist) / length
    near = 0.11 - np.linalg.norm(p - wrist - along[:, None] * (elbow - wrist) / length, axis=1)
    level = np.min([along - 0.012, 0.66 * length - along, near], axis=0)
    piece = tailoring.clip(shell, level)
    along = (piece.vertices - wrist) @ (elbow - wrist) / length
    rim = smoothstep(along, 0.04, 0.02) + smoothstep(along, 0.66 * length - 0.03, 0.66 * length - 0.01)
    name = "left bracer" if side > 0 else "right bracer"
    return dataclasses.replace(tailoring.spread_uvs(tailoring.let_out(piece, 0.008 + 0.004 * rim, 0.3, 3)), name=name)


def _thicken(skin: Piece, cut: _Cut) -> Piece:
    """The skin under straps, hair and beard, which lie a little outside it."""
    p = skin.vertices.astype(np.float64)
    scalp, beard = cut.scalp(p), faces.beard_area(cut.face, p)
    wild = scalp * (0.02 + 0.008 * noise(p * np.array([1, 1, 0.5]), 0.02, 23))
    grown = beard * (0.012 + 0.004 * noise(p * np.array([1, 0.4, 1]), 0.012, 24))
    # Not on the ears, whose folds would turn inside out.
    back, y = cut.face.eye[2] - p[:, 2], p[:, 1] - cut.face.eye[1]
    ear = faces.blob((back - 0.096) / 0.045, (y + 0.016) / 0.05, 0.7) * smoothstep(np.abs(p[:, 0]), 0.058, 0.068)
    thick = 0.006 * cut.harness(p) + (wild + grown) * (1 - ear)
    return tailoring.let_out(skin, thick, rounds=0)


def _paint_body(cut: _Cut, hollow: Callable[[np.ndarray], np.ndarray], p: np.ndarray) -> np.ndarray:
    face = cut.face
    colour = faces.paint_skin(face, p)
    # Furrows between the muscles are darker and redder, their bellies catch the light; not on the face.
    below = smoothstep(p[:, 1], face.eye[1] - 0.1, face.eye[1] - 0.14)
    depth = hollow(p) * below
    shade = _SKIN * np.array([0.72, 0.6, 0.54])
    colour = mix(colour, shade, 0.55 * smoothstep(depth, 0.0, 0.012))
    colour = mix(colour, _SKIN * 1.1, 0.5 * smoothstep(-depth, 0.0, 0.012))
    colour = mix(colour, shade, 0.55 * _furrows(cut, p))
    nipple = np.hypot(np.abs(p[:, 0]) - 0.098, p[:, 1] - cut.chest[1] + 0.055) * (1 + 9 * (p[:, 2] < 0.03))
    colour = mix(colour, np.array([168.0, 100, 84]), 0.8 * smoothstep(nipple, 0.012, 0.008))
    body_hair = 0.5 + 0.5 * noise(p, 0.004, 25)
    chest = faces.blob(p[:, 0] / 0.1, (p[:, 1] - cut.chest[1] + 0.02) / 0.09, 0.0) * (p[:, 2] > 0.04)
    colour = mix(colour, _HAIR * 0.8, 0.3 * chest * body_hair)
    colour = mix(colour, _WOAD, 0.85 * _war_paint(cut, p))
    leather = patterns.leather(p, _LEATHER, 26)
    edge = np.abs(cut.strap(p) - 0.023)
    leather = mix(leather, _LEATHER * 1.7, 0.8 * patterns.stitches(edge, p[:, 1] - p[:, 0], 0.0022))
    offset = p[:, :2] - cut.chest[:2]
    along = offset @ np.array([-0.62, -0.78])
    stud = np.hypot(cut.strap(p), along % 0.05 - 0.025)
    leather = mix(leather, _BRASS, smoothstep(stud, 0.009, 0.007))
    colour = mix(colour, leather, cut.harness(p))
    ring = np.hypot(offset[:, 0], offset[:, 1]) * 1.0
    colour = mix(colour, _BRASS, (p[:, 2] > 0.03) * smoothstep(ring, 0.04, 0.037))
    colour = mix(colour, _BRASS * 0.6, (p[:, 2] > 0.03) * smoothstep(np.abs(ring - 0.024), 0.004, 0.002))
    strands = 0.16 * noise(p * np.array([1, 0.35, 1]), 0.005, 3) + 0.14 * noise(p, 0.02, 4)
    grown = np.maximum(cut.scalp(p), faces.beard_area(face, p))
    return mix(colour, _HAIR * (1 + strands)[:, None], grown)


def _furrows(cut: _Cut, p: np.ndarray) -> np.ndarray:
    """Share of shade between the muscles of the front: the middle line, under the breast, between the six of the belly,
    and the groins."""
    x, y, front = np.abs(p[:, 0]), p[:, 1], p[:, 2] > 0.02
    low = cut.chest[1] - 0.095
    middle = smoothstep(x, 0.012, 0.002) * smoothstep(y, cut.waist - 0.02, cut.waist + 0.02) * (y < cut.chest[1] + 0.05)
    under = low + 0.055 * np.clip((x - 0.05) / 0.1, -0.2, 1.2) ** 2
    breast = smoothstep(np.abs(y - under), 0.016, 0.003) * (x < 0.17)
    belly = (y < low - 0.01) & (x < 0.078)
    step = (low - cut.waist + 0.01) / 3
    rungs = (
        smoothstep(np.abs((low - y) % step - step / 2), step / 2 - 0.013, step / 2 - 0.002)
        * belly
        * smoothstep(x, 0.08, 0.03)
    )
    side = smoothstep(np.abs(x - 0.075 - 0.1 * (y - cut.waist)), 0.014, 0.003) * (y < low)
    return front * np.clip(np.max([middle, breast, 0.8 * rungs, 0.8 * side], axis=0), 0, 1)


def _war_paint(cut: _Cut, p: np.ndarray) -> np.ndarray:
    """Share of woad: a hand's breadth of stripes over the right side of face, chest and arm, rings on the left arm."""
    y, x = p[:, 1] - cut.face.eye[1], p[:, 0]
    ragged = 0.004 * noise(p, 0.018, 27)
    front = p[:, 2] > cut.face.eye[2] - 0.06
    mask = front * smoothstep(np.abs(y - 0.004 + 3 * ragged * 0.3), 0.02, 0.016) * (np.abs(x) < 0.075)
    stripe = front * smoothstep(np.abs(x + 0.03 + ragged), 0.008, 0.006) * (np.abs(y) < 0.06)
    share = np.maximum(mask, stripe)
    breast = (x < 0.0) & (p[:, 2] > 0.03) & (np.abs(p[:, 1] - cut.chest[1]) < 0.12) & (x > -0.17)
    claw = np.abs((p[:, 1] - cut.chest[1] + 0.5 * x + ragged) % 0.04 - 0.02)
    share = np.maximum(share, breast * smoothstep(claw, 0.0095, 0.007) * (x < -0.035))
    along = cut.arm.along(p)
    arm = (np.abs(x) > cut.arm.joint[0] + 0.02) & (along > 0.1) & (along < 0.22)
    rings = np.abs((along + ragged) % 0.04 - 0.02)
    share = np.maximum(share, arm * smoothstep(rings, 0.010, 0.0075))
    return np.clip(share * (0.85 + 0.3 * noise(p, 0.012, 28)), 0, 1)


def _paint_hair(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    across = uv[:, 0] + 0.012 * np.sin(uv[:, 1] * 17 + uv[:, 0] * 30)
    line = np.stack([across, uv[:, 1] * 0.03, np.zeros(len(uv))], axis=1)
    streak = 0.2 * noise(line, 0.009, 9) + 0.2 * noise(line, 0.03, 10)
    return _HAIR * (0.96 + streak + 0.2 * (1 - uv[:, 1]))[:, None]


def _paint_kilt(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    u, v = uv[:, 0], uv[:, 1]
    colour = patterns.tartan(u * 14, v * 4.2, _TARTAN, _BAND, _LINE)
    colour = (
        colour
        * (1 + 0.05 * noise(p, 0.005, 11) - _pleats(u) * 0.22 * smoothstep(v, 0.87, 0.7) + 0.04 * noise(p, 0.05, 12))[
            :, None
        ]
    )
    colour = mix(colour, _BAND * 0.8, smoothstep(v, 0.02, 0.012))
    belt = smoothstep(v, 0.865, 0.872)
    leather = patterns.leather(p, _LEATHER, 13)
    rim = np.minimum(v - 0.87, 1 - v)
    leather = mix(leather, _LEATHER * 0.6, smoothstep(rim, 0.014, 0.008))
    studs = np.hypot(((u * 40) % 1 - 0.5) * 0.5, (v - 0.935) * 10)
    leather = mix(leather, _BRASS, smoothstep(studs, 0.17, 0.13))
    colour = mix(colour, leather, belt)
    buckle = np.hypot(p[:, 0], (v - 0.93) * 0.55) / 0.055
    front = p[:, 2] > 0
    colour = mix(colour, _BRASS, front * smoothstep(buckle, 1.0, 0.94))
    return mix(colour, _BRASS * 0.55, front * smoothstep(np.abs(buckle - 0.62), 0.14, 0.06))


def _pleats(u: np.ndarray) -> np.ndarray:
    """How deep in a fold of the kilt (n,) a place `u` of the way around is, 0 to 1."""
    behind = (u * 2 * np.pi - 0.75) / (2 * np.pi - 1.5)
    return (0.5 + 0.5 * np.cos(2 * np.pi * 22 * behind)) * (behind > 0.03) * (behind < 0.97)


def _paint_cape(p: np.ndarray, uv: np.ndarray) -> np.ndarray:
    u, v = uv[:, 0], uv[:, 1]
    edge = np.minimum(np.minimum(u, 1 - u) * 0.8, v * 1.05)
    ragged = 0.012 * noise(p, 0.02, 14)
    colour = patterns.canvas(p, _CAPE, 15) * (1 + 0.07 * np.cos(9 * np.pi * (2 * u - 1)) * (1 - v))[:, None]
    return mix(colour, patterns.fur(p, _FUR_DARK, _FUR_LIGHT), smoothstep(edge + ragged, 0.055, 0.045))


def _paint_bracer(rig: Rig, p: np.ndarray) -> np.ndarray:
    along = -limb(rig, "ForeArm", "Hand", "Hand").along(p)
    colour = patterns.leather(p, _LEATHER * 1.1, 16)
    band = np.abs((along - 0.012) % 0.056 - 0.028)
    colour = mix(colour, _STEEL, smoothstep(band, 0.010, 0.008))
    return mix(colour, _LEATHER * 0.6, 0.8 * smoothstep(np.abs(band - 0.013), 0.003, 0.0015))


def _paint_boot(p: np.ndarray, n: np.ndarray, uv: np.ndarray) -> np.ndarray:
    fur = patterns.fur(p, _FUR_DARK, _FUR_LIGHT * 0.95, 61)
    colour = mix(fur, patterns.leather(p, _LEATHER, 17), smoothstep(p[:, 1], 0.095, 0.08))
    # Thongs wind crosswise up the calf.
    u, v = uv[:, 0], uv[:, 1]
    wind = np.minimum(np.abs((u * 2 + v * 7) % 1 - 0.5), np.abs((u * 2 - v * 7) % 1 - 0.5))
    calf = smoothstep(p[:, 1], 0.1, 0.11) * smoothstep(v, 0.95, 0.93)
    colour = mix(colour, _LEATHER * 0.8, calf * smoothstep(wind, 0.1, 0.08))
    return mix(colour, np.array([52.0, 42, 36]), smoothstep(p[:, 1], 0.012, 0.006))
