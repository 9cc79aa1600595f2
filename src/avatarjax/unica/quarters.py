"""Quarter turns of groups: an exact symmetry of the task, for training (ours).

The figure faces where it runs. So a group turned about the vertical axis through the root of frame t, with its key
exchanged for the one that asks for the turned direction, is another true group. Gravity stays as it was.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

TOLERANCE_DEGREES = 20.0


def permutations(yaw: Float[np.ndarray, " a"], moves: Float[np.ndarray, " a"]) -> Int[np.ndarray, "4 a"]:
    """The action that each action (a,) becomes when the world is turned by 0, 1, 2 and 3 quarters towards +x.

    `yaw` and `moves` are what `fit.action_directions` measures. Actions that stand stay themselves. Raises ValueError
    where turned directions do not meet those of other actions.
    """
    table = np.tile(np.arange(len(yaw), dtype=np.int32), (4, 1))
    moving = np.flatnonzero(moves > 0)
    for quarter in range(1, 4):
        turned = yaw[moving] + quarter * np.pi / 2
        apart = np.abs((turned[:, None] - yaw[moving] + np.pi) % (2 * np.pi) - np.pi)
        nearest = apart.argmin(1)
        if np.rad2deg(apart.min(1)).max() > TOLERANCE_DEGREES or len(set(nearest)) < len(moving):
            degrees = np.rad2deg(yaw[moving]).round().astype(int).tolist()
            raise ValueError(f"directions of {degrees} degrees are not those of quarter turns: leave `rotate` off")
        table[quarter, moving] = moving[nearest]
    return table


def turn(groups: Float[np.ndarray, "b f t 3"], quarters: Int[np.ndarray, " b"]) -> Float[np.ndarray, "b f t 3"]:
    """Normalised groups turned by so many quarters, z towards x, about the vertical axis through (0.5, 0.5, 0.5)."""
    x, y, z = groups[..., 0], groups[..., 1], groups[..., 2]
    by = np.stack([groups, _columns(z, y, 1 - x), _columns(1 - x, y, 1 - z), _columns(1 - z, y, x)])
    return by[quarters, np.arange(len(groups))]


def _columns(*columns: np.ndarray) -> np.ndarray:
    return np.stack(columns, axis=-1)
