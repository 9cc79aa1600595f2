"""Painting skin: a face with brows, lips, lids and cheeks, and eyeballs with irises, from landmarks of the body."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from avatarjax.data.wardrobe import assembly
from avatarjax.data.wardrobe.garments import smoothstep
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


def relief(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rounds: int = 10
) -> Callable[[np.ndarray], np.ndarray]:
    """How hollow a skin is, as a function from points (n, 3) on it to metres (n,): positive in the furrows between
    muscles, negative on their bellies. `rounds` of smoothing tell the size of the forms, which are painted with it."""
    ones = np.ones(len(vertices), np.float32)
    smooth = assembly.relax(vertices, faces, ones, rounds)
    hollow = ((smooth - vertices) * assembly.vertex_normals(smooth, faces)).sum(1)
    tree = cKDTree(vertices)

    def at(p: np.ndarray) -> np.ndarray:
        distance, nearest = tree.query(p, k=4)
        share = 1 / (distance + 1e-4)
        return (hollow[nearest] * share).sum(1) / share.sum(1)

    return at


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
