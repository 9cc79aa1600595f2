"""From the box in which appearance works into the world (UNICA 3.7)."""

from __future__ import annotations

from jaxtyping import Array, Float

from avatarjax import gaussians as gs
from avatarjax import rotations
from avatarjax.gaussians import Gaussians


def place(gaussians: Gaussians, points: Float[Array, "n 3"]) -> Gaussians:
    """The cloud moved, turned and scaled so that its means fit `points` best, without changing its shape.

    Procrustes analysis over all points (UNICA 3.7); the rotation reaches the quaternions and the scale the log-scales.
    """
    scale, rotation, translation = rotations.similarity_fit(gaussians.means, points)
    return gs.transform(gaussians, scale, rotation, translation)
