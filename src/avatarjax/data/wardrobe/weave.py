"""Painting woven cloth: threads both ways, uneven dye, and shade in the folds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from avatarjax.data.wardrobe.textures import noise


def woven(
    colour: Float[np.ndarray, "3"],
    p: Float[np.ndarray, "n 3"],
    n: Float[np.ndarray, "n 3"] | None,
    threads: Float[np.ndarray, "n 2"],
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
