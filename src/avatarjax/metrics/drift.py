"""Does a long rollout stay near what it learned? Distance of each frame to the nearest training frame."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float


def nearest_distance(
    frames: Float[np.ndarray, "f t 3"], training: Float[np.ndarray, "n t 3"], *, chunk: int = 256
) -> Float[np.ndarray, "f"]:
    """Root mean square distance of each frame's points to those of the nearest training frame, in the same unit.

    Both are root-relative. Raises ValueError for frames that are not finite: "near" would then mean nothing.
    """
    if not np.isfinite(frames).all():
        raise ValueError("the rollout has frames that are not finite")
    points = frames.shape[1]
    known = jnp.asarray(training.reshape(len(training), -1))
    squared = jnp.sum(known**2, axis=1)

    @jax.jit
    def nearest(block):
        distance = jnp.sum(block**2, axis=1)[:, None] + squared[None] - 2 * block @ known.T
        return jnp.sqrt(jnp.maximum(jnp.min(distance, axis=1), 0) / points)

    flat = frames.reshape(len(frames), -1)
    return np.concatenate([np.asarray(nearest(jnp.asarray(flat[k : k + chunk]))) for k in range(0, len(flat), chunk)])
