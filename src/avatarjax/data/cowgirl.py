"""The cowgirl: a young woman in a shirt, a leather vest and a knee-length denim skirt, with long hair, boots and a
hat."""

from __future__ import annotations

import numpy as np

from avatarjax.data import garments, wardrobe
from avatarjax.data.body import load_body, shape
from avatarjax.data.textures import mix

_MACRO = {"caucasian-female-young": 1.0, "universal-female-young-averagemuscle-minweight": 0.25}
_SKIN = np.array([233.0, 186.0, 154.0])
_SHIRT = np.array([238.0, 226.0, 204.0])
_VEST = np.array([126.0, 76.0, 44.0])
_DENIM = np.array([62.0, 88.0, 138.0])
_HEM = np.array([232.0, 216.0, 186.0])
_BELT = np.array([74.0, 42.0, 26.0])


def look() -> wardrobe.Look:
    """Shape, dress and paint her; about a second."""
    body = load_body()
    vertices, rig = shape(body, _MACRO)
    head = {name: rig.heads[rig.index(name)] for name in rig.names}
    waist, knee = float(head["Spine"][1]) + 0.03, float(head["LeftLeg"][1])
    skin = wardrobe.body_piece(body, vertices, ("body",), "body")
    eyes = wardrobe.body_piece(body, vertices, ("helper-l-eye", "helper-r-eye"), "eyes")
    arms = [rig.index(n) for n in rig.names if "Arm" in n or "Hand" in n or "Shoulder" in n]
    trunk = skin.vertices[skin.weights[:, arms].sum(1) < 0.3]
    skirt, drape = garments.skirt(rig, trunk, top=waist, bottom=knee + 0.03)

    def paint_body(p, n, uv):
        return np.broadcast_to(_SKIN, p.shape)

    def paint_eyes(p, n, uv):
        return np.broadcast_to(np.array([240.0, 240, 240]), p.shape)

    def paint_skirt(p, n, uv):
        return mix(np.broadcast_to(_DENIM, p.shape), _HEM, (uv[:, 1] < 0.08) * 1.0)

    layers = [
        wardrobe.Layer(skin, (0.0, 0.0, 0.76, 0.76), paint_body),
        wardrobe.Layer(eyes, (0.0, 0.76, 0.76, 1.0), paint_eyes),
        wardrobe.Layer(skirt, (0.76, 0.0, 1.0, 0.4), paint_skirt),
    ]
    return wardrobe.assemble(rig, layers, drape)
