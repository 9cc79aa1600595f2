"""Colours that depend on the direction of view: real spherical harmonics of degree 0 to 3 (Kerbl et al. 2023)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians

# Coefficients of degree 1 and higher, by their number.
_DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}


def view_colors(gaussians: Gaussians, camera: Camera) -> Float[Array, "n 3"]:
    """What the camera sees of `colors` and `sh`: colors + sum of sh times the harmonics of the direction from the
    camera to each Gaussian, at least 0.

    Differentiable in the cloud, its means too, and the camera. Raises ValueError for a number of coefficients that is
    not that of degree 1, 2 or 3 without its constant: 3, 8 or 15.
    """
    if gaussians.sh is None:
        return gaussians.colors
    offsets = gaussians.means - camera.position[None]
    squared = jnp.sum(offsets * offsets, axis=-1, keepdims=True)
    # A Gaussian in the camera has no direction; it is not drawn.
    directions = offsets / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    if gaussians.sh.shape[1] not in _DEGREES:
        raise ValueError(f"gaussians.sh must have 3, 8 or 15 coefficients, got {gaussians.sh.shape[1]}")
    basis = harmonics(directions, _DEGREES[gaussians.sh.shape[1]])[:, 1:]
    return jnp.maximum(gaussians.colors + jnp.sum(basis[..., None] * gaussians.sh, axis=1), 0.0)


def harmonics(directions: Float[Array, "n 3"], degree: int) -> Float[Array, "n k"]:
    """The (degree + 1)^2 real spherical harmonics of unit vectors, in the order and with the signs of 3D Gaussian
    Splatting. Raises ValueError for a degree other than 0 to 3."""
    if degree not in range(4):
        raise ValueError(f"degree must be 0 to 3, got {degree}")
    x, y, z = (directions[:, k] for k in range(3))
    xx, yy, zz = x * x, y * y, z * z
    values = [0.28209479177387814 * jnp.ones_like(x)]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return jnp.stack(values, axis=1)
