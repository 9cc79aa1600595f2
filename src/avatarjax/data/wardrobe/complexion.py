"""Skin that is not young and rosy: the lines, spots and stubble of age, and the dark sockets of a ghost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.wardrobe.garments import smoothstep
from avatarjax.data.wardrobe.makeup import Face, blob
from avatarjax.data.wardrobe.textures import mix, noise


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
