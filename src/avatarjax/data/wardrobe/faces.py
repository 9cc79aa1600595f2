"""Painting faces: brows, lips, lids and cheeks, a beard's shade, the lines of age, dark sockets, and eyeballs."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from avatarjax.data.body import Body
from avatarjax.data.wardrobe import tailoring
from avatarjax.data.wardrobe.garments import Piece, smoothstep
from avatarjax.data.wardrobe.skin import body_piece
from avatarjax.data.wardrobe.textures import mix, noise


@dataclasses.dataclass(frozen=True, eq=False)
class Face:
    """Where a face is: eye (3,) the centre of the left eyeball, metres, radius of the eyeball; and its colours (3,).

    mouth is the height of the parting of the lips over the eye, metres; lash in [0, 1] how dark the lash line is, and
    heavy how thick the brows are, 1 as a woman's.
    """

    eye: Float[np.ndarray, "3"]
    radius: float
    skin: Float[np.ndarray, "3"]
    brow: Float[np.ndarray, "3"]
    lips: Float[np.ndarray, "3"]
    iris: Float[np.ndarray, "3"]
    aperture: float = 1.0
    mouth: float = -0.0605
    lash: float = 0.92
    heavy: float = 1.0


def blob(a: np.ndarray, b: np.ndarray, inner: float = 0.6) -> np.ndarray:
    """A soft ellipse: 1 inside, 0 where a^2 + b^2 > 1."""
    return smoothstep(np.sqrt(a * a + b * b), 1.0, inner)


def paint_skin(face: Face, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Skin colours (n, 3) in 0..255 at rest positions (n, 3), the face painted on."""
    x, y = np.abs(p[:, 0]), p[:, 1] - face.eye[1]
    front = smoothstep(p[:, 2], face.eye[2] - 0.055, face.eye[2] - 0.03) * (np.abs(y) < 0.14)
    colour = np.broadcast_to(face.skin, p.shape) * (1 + 0.02 * noise(p, 0.03)[:, None])
    rosy = face.skin * np.array([1.04, 0.78, 0.74])
    ex = x - face.eye[0]
    colour = mix(colour, rosy, 0.45 * front * blob((x - 0.042) / 0.03, (y + 0.038) / 0.024, 0.0))
    colour = mix(colour, rosy, 0.3 * front * blob(x / 0.013, (y + 0.036) / 0.013, 0.0))
    # Lids: shadow above the eye, a dark lash line around its opening.
    colour = mix(colour, face.skin * 0.66, 0.6 * front * blob(ex / 0.019, (y - 0.007) / 0.012, 0.2))
    lash = blob(ex / 0.0175, (y - 0.002) / (0.0095 * face.aperture), 0.8)
    colour = mix(colour, np.array([38.0, 24, 20]), face.lash * front * lash)
    arch = 0.0205 + 0.0045 * np.cos((ex - 0.004) / 0.02 * 1.5) - 0.0035
    thickness = (0.0036 * smoothstep(ex, 0.029, 0.0) + 0.0008) * face.heavy
    brow = blob((ex - 0.001) / 0.0245, (y - arch) / thickness, 0.5)
    colour = mix(colour, face.brow, 0.9 * front * brow)
    # The upper lip has a bow, the lower lip is fuller, a dark line parts them.
    middle = face.mouth
    bow = 0.0065 * np.sqrt(np.clip(1 - (x / 0.0235) ** 2, 0, 1)) - 0.0014 * np.exp(-((x / 0.004) ** 2))
    full = 0.0085 * np.sqrt(np.clip(1 - (x / 0.0215) ** 2, 0, 1))
    above, below = (y - middle) / np.maximum(bow, 1e-5), (middle - y) / np.maximum(full, 1e-5)
    lips = smoothstep(np.maximum(above, below), 1.05, 0.8) * (x < 0.023)
    colour = mix(colour, face.lips, front * lips)
    parting = blob(x / 0.022, (y - middle) / 0.0013, 0.4)
    return mix(colour, face.lips * 0.45, 0.85 * front * parting)


def beard_area(face: Face, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """1 (n,) where a man's beard grows at rest positions (n, 3): moustache, cheeks below a line from the ear to the
    corner of the mouth, jaw and throat; not on the lips."""
    x, y = np.abs(p[:, 0]), p[:, 1] - face.eye[1] - face.mouth
    back = face.eye[2] - p[:, 2]
    cheek = 0.012 + 0.55 * np.clip(back, 0, None) + 0.16 * np.clip(x - 0.03, 0, None)
    grown = smoothstep(y, cheek + 0.006, cheek - 0.008) * smoothstep(back, 0.098, 0.085)
    grown = grown * smoothstep(y, -0.085, -0.06)
    moustache = blob(x / 0.036, (y - 0.012) / 0.0125, 0.6) * (back < 0.02)
    lips = blob(x / 0.025, (y + 0.001) / 0.0095, 0.75) * (back < 0.03)
    return np.maximum(grown, moustache) * (1 - lips)


def paint_stubble(
    face: Face, colour: Float[np.ndarray, "n 3"], p: Float[np.ndarray, "n 3"], strength: float = 0.4
) -> Float[np.ndarray, "n 3"]:
    """Skin colours (n, 3) at rest positions (n, 3) with a few days' beard over them."""
    dots = 0.75 + 0.25 * noise(p, 0.0022, 31)
    return mix(colour, face.brow, strength * beard_area(face, p) * dots)


def _place(face: Face, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance from the middle, height above the eyes (both metres), and 1 in front."""
    x, y = np.abs(p[:, 0]), p[:, 1] - face.eye[1]
    return x, y, smoothstep(p[:, 2], face.eye[2] - 0.06, face.eye[2] - 0.03)


def age(
    face: Face, p: Float[np.ndarray, "n 3"], colour: Float[np.ndarray, "n 3"], amount: float = 1.0
) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) of painted skin at rest positions (n, 3) with lines of the forehead, crow's feet, bags, folds from
    the nose to the mouth, and spots on the scalp."""
    x, y, front = _place(face, p)
    dark = face.skin * np.array([0.66, 0.56, 0.52])
    bend = 0.006 * np.cos(x / 0.03 * 1.6)
    for level, width in ((0.040, 0.045), (0.051, 0.048), (0.062, 0.04)):
        line = blob(x / width, (y - level - bend) / 0.0017, 0.3)
        colour = mix(colour, dark, 0.4 * amount * front * line)
    # Lines fan out from the outer corner of the eye.
    for slope, length in ((0.45, 0.014), (0.0, 0.017), (-0.5, 0.014)):
        along = x - face.eye[0] - 0.024
        line = blob((along - length / 2) / length, (y - slope * along) / 0.0013, 0.3)
        colour = mix(colour, dark, 0.4 * amount * front * line)
    bag = blob((x - face.eye[0]) / 0.02, (y + 0.0165 - 0.2 * np.abs(x - face.eye[0])) / 0.003, 0.2)
    colour = mix(colour, dark, 0.5 * amount * front * bag)
    fold = x - 0.019 - 0.75 * np.clip(-y - 0.036, 0, None)
    colour = mix(
        colour, dark, 0.35 * amount * front * blob(fold / 0.0028, (y + 0.053) / 0.023, 0.2) * (p[:, 2] > face.eye[2])
    )
    # Spots of sizes from a lentil to a thumbnail, all over the scalp.
    random = np.random.default_rng(21)
    centre, spots = face.eye * np.array([0, 1, 1]) + np.array([0, 0.03, -0.085]), np.zeros(len(p))
    way = (p - centre) / np.maximum(np.linalg.norm(p - centre, axis=1, keepdims=True), 1e-6)
    for spot, size in zip(random.normal([0, 1.1, 0], size=(22, 3)), random.uniform(0.025, 0.075, 22), strict=True):
        away = np.linalg.norm(way - spot / np.linalg.norm(spot), axis=1) * (1 + 0.25 * noise(p, 0.006, 22))
        spots = np.maximum(spots, smoothstep(away / size, 1.0, 0.5))
    spots = spots * smoothstep(y, 0.045, 0.07)
    return mix(colour, face.skin * np.array([0.78, 0.66, 0.58]), 0.45 * amount * spots)


def sockets(
    face: Face, p: Float[np.ndarray, "n 3"], colour: Float[np.ndarray, "n 3"], shade: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) with eye sockets and hollow cheeks of a shade (3,) under what is painted on the lids."""
    x, y, front = _place(face, p)
    ex = x - face.eye[0]
    lid = blob(ex / 0.0175, (y - 0.002) / (0.0095 * face.aperture), 0.8)
    ring = blob(ex / 0.031, (y + 0.003) / 0.025, 0.15) * (1 - lid)
    colour = mix(colour, shade, 0.75 * front * ring)
    tear = blob((ex + 0.002) / 0.006, (y + 0.032) / 0.03, 0.0)
    colour = mix(colour, shade, 0.25 * front * tear)
    return mix(colour, shade, 0.3 * front * blob((x - 0.048) / 0.02, (y + 0.052) / 0.026, 0.0))


def eyeballs(
    body: Body, vertices: Float[np.ndarray, "v 3"], margin: float = 0.01
) -> tuple[Piece, Float[np.ndarray, "3"], float]:
    """Both eyeballs of the shaped body (v, 3), whose uvs fill their square but for a `margin`, and the centre (3,) and
    the radius of the left one, metres."""
    eyes = body_piece(body, vertices, ("helper-l-eye", "helper-r-eye"), "eyes")
    left = eyes.vertices[eyes.vertices[:, 0] > 0]
    return tailoring.spread_uvs(eyes, margin), left.mean(0), float(np.ptp(left[:, 1]) / 2)


def paint_eyes(face: Face, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) of both eyeballs: white, iris, pupil and a glint, by the distance from the optical axis."""
    x = np.abs(p[:, 0]) - face.eye[0]
    y = p[:, 1] - face.eye[1]
    away = np.hypot(x, y) / face.radius
    white = np.array([240.0, 238.0, 234.0]) * (1 - 0.25 * smoothstep(away, 0.5, 1.0))[:, None]
    colour = mix(white, face.iris * 0.5, smoothstep(away, 0.62, 0.56))
    colour = mix(colour, face.iris, smoothstep(away, 0.54, 0.4))
    colour = mix(colour, np.array([14.0, 10, 10]), smoothstep(away, 0.27, 0.22))
    # The glint lies on the same side of both eyes, where the lamp is.
    glint = np.hypot(p[:, 0] - np.sign(p[:, 0]) * face.eye[0] - 0.22 * face.radius, y - 0.22 * face.radius)
    return mix(colour, np.array([255.0, 255, 255]), smoothstep(glint / face.radius, 0.16, 0.1))
