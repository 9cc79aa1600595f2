"""Joints from the surface: each one a fixed affine combination of surface points near it, as SMPL's regressor is."""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from avatarjax.metrics import checks

# Frames in which the distance of a joint to the points is looked at.
_PROBES = 32


@typing.no_type_check
@flax.struct.dataclass
class JointRegressor:
    """For each of j joints the k points (j, k) that it is made of, and their weights (j, k), each row with sum 1.

    Weights may be negative: a joint lies inside the body, and clothes hang off it.
    """

    points: Int[Array, "j k"]
    weights: Float[Array, "j k"]


def fit(
    points: Float[np.ndarray, "n t 3"],
    joints: Float[np.ndarray, "m j 3"],
    *,
    nearest: int = 128,
    ridge: float = 1e-4,
) -> JointRegressor:
    """Fit a regressor to n frames of surface points and joints in the same frame of reference and unit.

    Each joint uses the `nearest` points to it (on average; all, if there are fewer) with the weights of a ridge
    regression that shrinks towards their plain mean (`ridge` times the points' mean variance; it must be positive,
    because points of a rigid part say the same thing many times). The weights' sum is 1 and they do not know x from y
    from z, so `regress` turns and moves with the points. Loper et al. 2015 (SMPL) fit theirs with non-negative weights
    to a bare body; ours may be negative.

    Raises ValueError for shapes that do not fit, numbers that are not finite, and settings out of range.
    """
    points = checks.finite("points", points, (None, None, 3))
    joints = checks.finite("joints", joints, (len(points), None, 3))
    if nearest < 1 or not 0 < ridge < np.inf:
        raise ValueError(f"nearest must be at least 1 and ridge positive, got {nearest} and {ridge}")
    probes = np.unique(np.linspace(0, len(points) - 1, _PROBES).astype(int))
    count = min(nearest, points.shape[1])
    chosen, weights = [], []
    for j in range(joints.shape[1]):
        distance = np.linalg.norm(points[probes] - joints[probes, None, j], axis=-1).mean(0)
        near = np.sort(np.argpartition(distance, count - 1)[:count])
        around = points[:, near]
        centre = around.mean(axis=1, keepdims=True)
        # About their mean the points sum to zero, so the part of the weights that the data determine does too: the sum
        # of all weights stays that of the plain mean, 1.
        design = (around - centre).transpose(0, 2, 1).reshape(-1, count)
        target = (joints[:, j] - centre[:, 0]).reshape(-1)
        gram = design.T @ design
        gram[np.diag_indices(count)] += ridge * max(np.trace(gram) / count, np.finfo(np.float64).tiny)
        chosen.append(near)
        weights.append(1 / count + scipy.linalg.solve(gram, design.T @ target, assume_a="pos"))
    return JointRegressor(jnp.asarray(np.stack(chosen), jnp.int32), jnp.asarray(np.stack(weights), jnp.float32))


@jax.jit
def regress(regressor: JointRegressor, points: Float[Array | np.ndarray, "*b t 3"]) -> Float[Array, "*b j 3"]:
    """Joints (..., j, 3) of surface points (..., t, 3), in the points' frame of reference and unit."""
    points = jnp.asarray(points)
    # About a point of the surface: sums of weights times large coordinates would lose digits far from the origin.
    origin = points[..., :1, :]
    near = (points - origin)[..., regressor.points, :]
    return jnp.einsum("...jkc,jk->...jc", near, regressor.weights) + origin
