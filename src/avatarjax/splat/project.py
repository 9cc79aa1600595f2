"""EWA projection: from 3D Gaussians to 2D Gaussians on the image plane (Zwicker et al. 2001; gsplat's conventions).

Everything is written per component: XLA on CPU is slow at batches of 3x3 products.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.splat import columns
from avatarjax.splat.config import ALPHA_MIN, SplatConfig

# Square pixels. The determinant of larger covariances would come near the largest float32.
_VARIANCE_MAX = 1e15
# Larger sizes, 10^13 metres, would overflow in the gradient before they are found to be too large.
_LOG_SCALE_MAX = 30.0
_LOG2_E = math.log2(math.e)

# Columns of the table of projected Gaussians, one row each, which the blending reads at once.
# X, Y: centre in pixels. XX, XY, YY, LOG2_OPACITY: the base-2 logarithm of alpha at (dx, dy) pixels from the centre is
# XX dx^2 + XY dx dy + YY dy^2 + LOG2_OPACITY. From CHANNELS on: the features, then at DEPTH metres along the optical
# axis. EXTENT_X, EXTENT_Y: half the sides, in pixels, of the bounding box of the ellipse in which alpha is at least
# ALPHA_MIN; not differentiable.
X, Y, XX, XY, YY, LOG2_OPACITY, CHANNELS = range(7)
DEPTH, EXTENT_X, EXTENT_Y = -3, -2, -1


def project(
    gaussians: Gaussians, features: Float[Array, "n d"], camera: Camera, config: SplatConfig
) -> tuple[Float[Array, "n k"], Bool[Array, " n"]]:
    """The table of n Gaussians as one camera sees them, and which of them are free of NaN, infinity and overflow.

    Those that are not drawn have no extent, and values without meaning.

    The perspective is linearised at each centre, which is first moved to within 1.3 times the field of view: farther
    out the linearisation would spread a Gaussian over the whole image (Kerbl et al. 2023, and gsplat).
    """
    finite = _finite(gaussians, features)
    # Masked values go in, not only out: the gradient of a masked result is 0 * NaN otherwise.
    x, y, z = (jnp.where(finite, x, 0.0) for x in columns.split(gaussians.means))
    log_scales = jnp.where(finite[:, None], jnp.minimum(gaussians.log_scales, _LOG_SCALE_MAX), 0.0)
    scales = [jnp.exp(s) for s in columns.split(log_scales)]
    quats = jnp.where(finite[:, None], gaussians.quats, jnp.ones_like(gaussians.quats))

    r, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    fx, fy = camera.intrinsics[0, 0], camera.intrinsics[1, 1]
    cx, cy = camera.intrinsics[0, 2], camera.intrinsics[1, 2]
    cam_x, cam_y, cam_z = (x * r[i, 0] + y * r[i, 1] + z * r[i, 2] + t[i] for i in range(3))
    in_front = cam_z > config.near
    depth = jnp.where(in_front, cam_z, 1.0)
    inverse_depth = 1 / depth
    slope_x, slope_y = cam_x * inverse_depth, cam_y * inverse_depth

    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    near_x = depth * jnp.clip(slope_x, -cx / fx - margin_x, (camera.width - cx) / fx + margin_x)
    near_y = depth * jnp.clip(slope_y, -cy / fy - margin_y, (camera.height - cy) / fy + margin_y)
    # Rows of the 2x3 matrix J W: the Jacobian of the perspective times the rotation into the camera.
    j_xx, j_xz = fx * inverse_depth, -fx * near_x * inverse_depth * inverse_depth
    j_yy, j_yz = fy * inverse_depth, -fy * near_y * inverse_depth * inverse_depth
    row_x = [j_xx * r[0, i] + j_xz * r[2, i] for i in range(3)]
    row_y = [j_yy * r[1, i] + j_yz * r[2, i] for i in range(3)]
    # Principal axes on the image plane, scaled: the covariance is the sum of their outer products.
    axes = _rotation_columns(quats)
    ax, ay = (
        [
            columns.materialize(s * (row[0] * a[0] + row[1] * a[1] + row[2] * a[2]))
            for a, s in zip(axes, scales, strict=True)
        ]
        for row in (row_x, row_y)
    )
    variance_x = ax[0] * ax[0] + ax[1] * ax[1] + ax[2] * ax[2] + config.eps2d
    variance_y = ay[0] * ay[0] + ay[1] * ay[1] + ay[2] * ay[2] + config.eps2d
    covariance = ax[0] * ay[0] + ax[1] * ay[1] + ax[2] * ay[2]
    bounded = (variance_x < _VARIANCE_MAX) & (variance_y < _VARIANCE_MAX)
    # Lagrange's identity: the difference variance_x * variance_y - covariance^2 as a sum of squares, so that thin and
    # large Gaussians do not lose it to rounding.
    crosses = [ax[0] * ay[1] - ax[1] * ay[0], ax[1] * ay[2] - ax[2] * ay[1], ax[2] * ay[0] - ax[0] * ay[2]]
    determinant = sum(c * c for c in crosses) + config.eps2d * (variance_x + variance_y - config.eps2d)
    inverse = 1 / jnp.where(bounded, determinant, 1.0)
    log_opacity = _log_opacities(jnp.where(finite, gaussians.logit_opacities, 0.0))
    if config.antialiased:
        # What the blur adds to the area it takes from the opacity. Less than ALPHA_MIN^2 is invisible in any case.
        ratio = sum(c * c for c in crosses) * inverse
        log_opacity = log_opacity + 0.5 * jnp.log(jnp.maximum(ratio, 0.5 * ALPHA_MIN**2))
    reach = jnp.where(finite & in_front & bounded, 2 * (log_opacity - math.log(ALPHA_MIN)), 0.0)
    reach = lax.stop_gradient(jnp.maximum(reach, 0.0))
    conic = [-0.5 * variance_y * inverse, covariance * inverse, -0.5 * variance_x * inverse]
    center = [fx * slope_x + cx, fy * slope_y + cy]
    logarithms = [_LOG2_E * c for c in (*conic, log_opacity)]
    extents = [jnp.sqrt(reach * lax.stop_gradient(v)) for v in (variance_x, variance_y)]
    channels = [jnp.where(finite, f, 0.0) for f in columns.split(features)]
    table = columns.join([*center, *logarithms, *channels, depth, *extents])
    return table, finite & (bounded | ~in_front)


def _finite(gaussians: Gaussians, features: Float[Array, "n d"]) -> Bool[Array, " n"]:
    """False for a Gaussian with a NaN or infinite parameter; an infinite logit is only an opacity of 0 or 1."""
    # Reductions, though over few numbers: XLA computes them once, and not again in all that depends on them.
    rows = (gaussians.means, gaussians.quats, gaussians.scales, features)
    finite = ~jnp.isnan(gaussians.logit_opacities)
    for row in rows:
        finite &= jnp.all(jnp.isfinite(row), axis=1)
    return finite


def _log_opacities(logits: Float[Array, " n"]) -> Float[Array, " n"]:
    # Several times as fast on CPU as log_sigmoid, whose care for very small opacities is lost below ALPHA_MIN.
    return -jnp.log(1 + jnp.exp(-jnp.maximum(logits, -30.0)))


def _rotation_columns(quats: Float[Array, "n 4"]) -> list[tuple[Float[Array, " n"], ...]]:
    # `rotations.normalize` per component: its sum over four numbers was a quarter of the gradient's time on CPU.
    w, x, y, z = columns.split(quats)
    scale = lax.rsqrt(jnp.maximum(w * w + x * x + y * y + z * z, 1e-12))
    w, x, y, z = (scale * q for q in (w, x, y, z))
    return [
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    ]
