"""Painting stuffs: woven cloth, canvas, leather, fur and tartan as colours on a surface."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.wardrobe.garments import smoothstep
from avatarjax.data.wardrobe.textures import mix, noise


def woven(
    p: Float[np.ndarray, "n 3"],
    colour: Float[np.ndarray, "3"],
    threads: Float[np.ndarray, "n 2"],
    n: Float[np.ndarray, "n 3"] | None = None,
    *,
    coarse: float = 0.05,
    shade: float = 0.22,
) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) of a cloth of one colour (3,) at positions p (n, 3) with normals n (n, 3).

    `threads` (n, 2) are metres along both threads; `coarse` is how uneven they are. Where a normal turns away from the
    direction outwards from the figure, on the flank of a fold, it is darker by up to `shade`; without normals it is
    not.
    """
    flat = np.concatenate([threads, np.zeros((len(threads), 1))], axis=1)
    warp = noise(flat * np.array([1, 0.1, 1]), 0.005, 3) + noise(flat * np.array([0.1, 1, 1]), 0.005, 2)
    light = 1 + coarse * warp + 0.06 * noise(p, 0.06, 4)
    if n is not None:
        out, level = p[:, [0, 2]], n[:, [0, 2]]
        lengths = np.linalg.norm(out, axis=1) * np.linalg.norm(level, axis=1)
        light = light - shade * (1 - np.clip((out * level).sum(1) / np.maximum(lengths, 1e-6), 0, 1))
    return colour * light[:, None]


def canvas(p: Float[np.ndarray, "n 3"], colour: Float[np.ndarray, "3"], seed: int = 50) -> Float[np.ndarray, "n 3"]:
    """Coarse cloth (n, 3) of a colour in 0..255 at points (n, 3), metres: threads and worn places."""
    across = 0.035 * noise(p * np.array([1, 0.2, 1]), 0.007, seed) + 0.035 * noise(p * np.array([0.2, 1, 0.2]), 0.007)
    return colour * (1 + across + 0.06 * noise(p, 0.07, seed + 1))[:, None]


def tartan(
    across: Float[np.ndarray, " n"],
    down: Float[np.ndarray, " n"],
    ground: Float[np.ndarray, "3"],
    band: Float[np.ndarray, "3"],
    line: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "n 3"]:
    """A tartan (n, 3) of colours in 0..255: broad bands and thin lines in both directions; coordinates in setts."""

    def stripes(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away = np.abs(x % 1 - 0.5)
        broad = smoothstep(away, 0.2, 0.185)
        gap = smoothstep(np.abs(away - 0.13), 0.025, 0.018)
        thin = smoothstep(np.abs(x % 1 - 0.0), 0.03, 0.022) + smoothstep(np.abs(x % 1 - 1.0), 0.03, 0.022)
        return broad * (1 - gap), np.clip(thin, 0, 1)

    (warp, thin_warp), (weft, thin_weft) = stripes(across), stripes(down)
    colour = mix(np.broadcast_to(ground, (len(across), 3)), band, 0.5 * warp + 0.5 * weft)
    return mix(colour, line, 0.85 * np.maximum(thin_warp, thin_weft))


def leather(p: Float[np.ndarray, "n 3"], colour: Float[np.ndarray, "3"], seed: int = 40) -> Float[np.ndarray, "n 3"]:
    """Worn leather (n, 3) of a colour in 0..255 at points (n, 3), metres: blotches and a fine grain."""
    return colour * (1 + 0.1 * noise(p, 0.05, seed) + 0.06 * noise(p, 0.012, seed + 1))[:, None]


def fur(
    p: Float[np.ndarray, "n 3"], dark: Float[np.ndarray, "3"], light: Float[np.ndarray, "3"], seed: int = 60
) -> Float[np.ndarray, "n 3"]:
    """Fur (n, 3) at points (n, 3), metres, between a colour of its depth and one of its tips, in tufts that fall."""
    wander = 0.012 * noise(p, 0.05, seed)
    q = np.stack([p[:, 0] + wander, 0.3 * p[:, 1], p[:, 2] + wander], axis=1)
    tuft = 0.5 + 0.45 * noise(q, 0.011, seed + 1) + 0.3 * noise(q, 0.0045, seed + 2) + 0.2 * noise(p, 0.06, seed + 3)
    return mix(np.broadcast_to(dark, p.shape), light, smoothstep(tuft, 0.1, 0.95))


def stitches(away: Float[np.ndarray, " n"], along: Float[np.ndarray, " n"], width: float = 0.0016) -> np.ndarray:
    """1 on the stitches (n,) of a seam: `away` metres from it, `along` metres on it; each 9 mm with a gap."""
    return smoothstep(np.abs(away), width, width * 0.6) * (along % 0.009 < 0.006)
