"""Rotations: quaternions (w, x, y, z), matrices, and the rigid fit between point sets.

Quaternions are normalised where they are used, so any non-zero 4-vector stands for a rotation. Batch axes come first
everywhere; functions broadcast over them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_TINY = 1e-12
# Squarings of a 4x4 matrix, after which its first eigenvector is all that is left of it.
_SQUARINGS = 4
# What every turn is resisted by beside what a matrix itself resists it, as a share of its trace. Well determined
# rotations lose a tenth of their gradient by it; without it, those of flat and thin surroundings drown all others
# (0.4 dB of trained pictures in docs/smad.md's cowgirl).
_HELD = 0.05


def normalize(q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Unit quaternion; a zero quaternion becomes zero, with a finite gradient."""
    return q * jax.lax.rsqrt(jnp.maximum(jnp.sum(q * q, axis=-1, keepdims=True), _TINY))


def multiply(a: Float[Array, "*b 4"], b: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    """Hamilton product: rotating by `multiply(a, b)` is rotating by b, then by a."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def to_matrix(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrix of a quaternion of any non-zero length."""
    w, x, y, z = jnp.moveaxis(normalize(q), -1, 0)
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
    ]
    return jnp.stack(rows, axis=-2)


def from_matrix(r: Float[Array, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Unit quaternion with w >= 0 of a rotation matrix.

    All four of Shepperd's candidates are formed and the best conditioned one is taken, so that there is no branch and
    no division by a small number (Shepperd 1978, "Quaternion from rotation matrix").
    """
    m = [[r[..., i, j] for j in range(3)] for i in range(3)]
    candidates = jnp.stack(
        [
            jnp.stack([1 + m[0][0] + m[1][1] + m[2][2], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]], -1),
            jnp.stack([m[2][1] - m[1][2], 1 + m[0][0] - m[1][1] - m[2][2], m[0][1] + m[1][0], m[0][2] + m[2][0]], -1),
            jnp.stack([m[0][2] - m[2][0], m[0][1] + m[1][0], 1 - m[0][0] + m[1][1] - m[2][2], m[1][2] + m[2][1]], -1),
            jnp.stack([m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1 - m[0][0] - m[1][1] + m[2][2]], -1),
        ],
        axis=-2,
    )
    best = jnp.argmax(jnp.diagonal(candidates, axis1=-2, axis2=-1), axis=-1)
    q = normalize(jnp.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :])
    return jnp.where(q[..., :1] < 0, -q, q)


@jax.custom_jvp
def nearest(matrices: Float[Array, "n 3 3"]) -> Float[Array, "n 4"]:
    """Unit quaternions of the rotations nearest to matrices of positive determinant, in the sense of least squares.

    They are the eigenvectors to the largest eigenvalues of symmetric 4x4 matrices (Davenport's solution of Wahba's
    problem, Keat 1977), which repeated squaring brings out: a batched SVD takes a hundred times as long on a CPU.
    Derivatives are those of the polar decomposition, held back the more a matrix leaves the rotation open.
    """
    size = jnp.sqrt(jnp.mean(jnp.sum(matrices**2, axis=-1), axis=-1))
    m = matrices / jnp.maximum(size, _TINY)[:, None, None]
    trace = jnp.trace(m, axis1=-2, axis2=-1)[:, None]
    axis = jnp.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=-1)
    square = m + jnp.swapaxes(m, -1, -2) - trace[..., None] * jnp.eye(3)[None]
    top = jnp.concatenate([trace, axis], axis=-1)[:, None]
    k = jnp.concatenate([top, jnp.concatenate([axis[..., None], square], axis=-1)], axis=1) + jnp.eye(4)[None]
    for _ in range(_SQUARINGS):
        k = jnp.sum(k[..., None] * k[:, None], axis=2)
        k = k / jnp.trace(k, axis1=-2, axis2=-1)[:, None, None]
    best = jnp.argmax(jnp.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    return normalize(jnp.take_along_axis(k, best[:, None, None], axis=1)[:, 0])


@nearest.defjvp
def _nearest_jvp(
    primals: tuple[Float[Array, "n 3 3"]], tangents: tuple[Float[Array, "n 3 3"]]
) -> tuple[Float[Array, "n 4"], Float[Array, "n 4"]]:
    """Of M = R S, S symmetric: dR = R [w], where (tr S - S) w is the axis of R^T dM - dM^T R."""
    quats = nearest(*primals)
    turn = to_matrix(quats)
    size = jnp.maximum(jnp.sqrt(jnp.sum(primals[0] ** 2, axis=(-2, -1))), _TINY)[:, None, None]

    def aligned(matrices):
        return jnp.sum(turn[:, :, :, None] * matrices[:, :, None] / size[..., None], axis=1)

    s, change = aligned(primals[0]), aligned(tangents[0])
    trace = (1 + _HELD) * (s[:, 0, 0] + s[:, 1, 1] + s[:, 2, 2])
    a, b, c = (trace - s[:, k, k] for k in range(3))
    d, e, f = (-(s[:, i, j] + s[:, j, i]) / 2 for i, j in ((1, 2), (0, 2), (0, 1)))
    # The inverse of [[a, f, e], [f, b, d], [e, d, c]] is that of its cofactors.
    first = [b * c - d * d, d * e - f * c, f * d - b * e]
    others = [a * c - e * e, e * f - a * d, a * b - f * f]
    determinant = jnp.maximum(a * first[0] + f * first[1] + e * first[2], _TINY)
    inverse = [first, [first[1], *others[:2]], [first[2], *others[1:]]]
    axis = [change[:, i, j] - change[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))]
    turning = [sum(x * y for x, y in zip(row, axis, strict=True)) for row in inverse]
    half = jnp.stack([jnp.zeros_like(determinant), *turning], axis=-1) / (2 * determinant[:, None])
    return quats, multiply(quats, half)


def nlerp(a: Float[Array, "*b 4"], b: Float[Array, "*b 4"], weight: Float[Array, "*b"] | float) -> Float[Array, "*b 4"]:
    """Normalised linear interpolation along the shorter arc; `weight` 0 gives a, 1 gives b."""
    weight = jnp.asarray(weight)[..., None]
    b = jnp.where(jnp.sum(a * b, axis=-1, keepdims=True) < 0, -b, b)
    return normalize(a * (1 - weight) + b * weight)


def from_axis_angle(rotvec: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Quaternion of a rotation vector (axis times angle in radians), differentiable at zero."""
    # The inner where keeps sqrt away from 0, whose gradient is infinite there.
    squared = jnp.sum(rotvec * rotvec, axis=-1, keepdims=True)
    small = squared < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    scale = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle)
    w = jnp.where(small, 1 - squared / 8, jnp.cos(angle / 2))
    return jnp.concatenate([w, scale * rotvec], axis=-1)


def to_axis_angle(q: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Rotation vector with angle in [0, pi] of a quaternion, differentiable at the identity."""
    q = normalize(q)
    q = jnp.where(q[..., :1] < 0, -q, q)
    squared = jnp.sum(q[..., 1:] ** 2, axis=-1, keepdims=True)
    small = squared < 1e-10
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    return q[..., 1:] * jnp.where(small, 2.0, 2 * jnp.arctan2(sine, q[..., :1]) / sine)


def yaw_matrix(yaw: Float[Array, "*b"]) -> Float[Array, "*b 3 3"]:
    """Rotation about +y that takes +z to (sin yaw, 0, cos yaw): yaw 0 faces +z, yaw 90 degrees faces +x."""
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    rows = [jnp.stack([c, zero, s], -1), jnp.stack([zero, one, zero], -1), jnp.stack([-s, zero, c], -1)]
    return jnp.stack(rows, axis=-2)


def similarity_fit(
    source: Float[Array, "n 3"], target: Float[Array, "n 3"], weights: Float[Array, " n"] | None = None
) -> tuple[Float[Array, ""], Float[Array, "3 3"], Float[Array, " 3"]]:
    """Least-squares scale, rotation and translation with target ~ scale * R @ source + t (Procrustes analysis).

    Reflections are excluded (Umeyama 1991, "Least-squares estimation of transformation parameters between two point
    patterns"). `weights` (n,), non-negative, weigh the points; none means equal weights.
    """
    w = jnp.ones(source.shape[0], source.dtype) if weights is None else weights
    w = w / jnp.sum(w)
    mean_s, mean_t = w @ source, w @ target
    s, t = source - mean_s[None], target - mean_t[None]
    u, d, vt = jnp.linalg.svd((t * w[:, None]).T @ s)
    sign = jnp.where(jnp.linalg.det(u) * jnp.linalg.det(vt) < 0, -1.0, 1.0)
    flip = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), sign])
    rotation = (u * flip[None]) @ vt
    scale = jnp.sum(d * flip) / jnp.maximum(jnp.sum(w[:, None] * s * s), _TINY)
    return scale, rotation, mean_t - scale * rotation @ mean_s
