"""Feet that stay where they stand: a correction of each predicted frame by what is known of contacts (ours).

A foot that is on the ground in two successive frames has not moved. Taken as an observation of the predicted step with
a Gaussian error, whose covariance is that of the model on its training data, this has the closed form of a Kalman
update: the error in the foot's place is shared out among pose and root as the model's errors are correlated. Nearly all
of it goes to the root's step, which a denoiser of coefficients knows to 5 mm only, while pose and contact determine it.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.posmap import pca as pcs

# A foot stands while its lowest sole point is lower than this in both frames, metres.
HEIGHT = 0.015
# A foot that moves further in one frame than this, metres, swings close to the ground and does not stand.
SWING = 0.05
# Sole points a foot, at most and at least: of a boot under a coat few texels are seen.
POINTS = (8, 3)
# Frames in which some sole point must be seen at rest for there to be a foot, and the share of them for further points.
SEEN, OFTEN = 10, 0.25
ROOT = 3


@typing.no_type_check
@flax.struct.dataclass
class Stance:
    """Which texels (2, p) are the left and the right sole, and how sure what is.

    spread (k + 3, k + 3) is the symmetric square root of the covariance of the model's errors in a step, coefficients
    of the pose first and then the root in metres, metres and radians; slack () is how far a foot that stands moves in a
    frame, metres, as a standard deviation along either axis of the ground.
    """

    soles: Int[Array, "2 p"]
    spread: Float[Array, "d d"]
    slack: Float[Array, ""]


def hold(
    stance: Stance,
    basis: pcs.PCA,
    before: Float[Array, "b k"],
    after: Float[Array, "b k"],
    step: Float[Array, "b 3"],
) -> tuple[Float[Array, "b k"], Float[Array, "b 3"]]:
    """Predicted poses `after` and root steps `step` (x, z, yaw, seen from the frame before), corrected.

    Poses are coefficients of heading-relative maps in metres, heights above the ground included. Where no foot stands,
    nothing changes.
    """
    count = before.shape[1]
    axes = basis.basis.reshape(count, -1, 3)[:, stance.soles]
    mean = basis.mean.reshape(-1, 3)[stance.soles]
    middles = axes.mean(2)

    def feet(pose):
        """The middle (2, 3) of either sole, and the height (2,) of its lowest point."""
        points = jnp.tensordot(pose, axes, 1) + mean
        return points.mean(1), points[..., 1].min(1)

    def turned(yaw, points):
        """Ground positions (..., 2) of points (..., 3) after a turn."""
        c, s = jnp.cos(yaw), jnp.sin(yaw)
        return jnp.stack([c * points[..., 0] + s * points[..., 2], c * points[..., 2] - s * points[..., 0]], axis=-1)

    def correct(before, after, step):
        (stood, low), (stands, still_low) = feet(before), feet(after)
        there = turned(step[2], stands)
        slid = there + step[None, :2] - stood[:, ::2]
        resting = (low < HEIGHT) & (still_low < HEIGHT) & (jnp.sum(slid**2, axis=1) < SWING**2)
        seen = jnp.repeat(resting.astype(slid.dtype), 2)
        # How the ground positions change with the pose, with the root's place and with its heading.
        by_pose = turned(step[2], middles).reshape(count, 4)
        by_heading = jnp.stack([there[:, 1], -there[:, 0]], axis=-1).reshape(1, 4)
        slope = jnp.concatenate([by_pose, jnp.tile(jnp.eye(2), (1, 2)), by_heading])
        factor = (seen[:, None] * slope.T) @ stance.spread
        # What is not seen has no say; the floor of a hundredth of a millimetre keeps a slack of zero solvable.
        innovation = factor @ factor.T + jnp.diag(jnp.where(seen > 0, stance.slack**2 + 1e-10, 1.0))
        change = -stance.spread @ (factor.T @ jnp.linalg.solve(innovation, seen * slid.reshape(4)))
        return after + change[:count], step + change[count:]

    return jax.vmap(correct)(before, after, step)


def find_soles(
    texels: Float[np.ndarray, "f t 3"],
    roots: Float[np.ndarray, "f 3"],
    sequence: Int[np.ndarray, " f"],
    standing: Float[np.ndarray, "t 3"],
) -> tuple[Int[np.ndarray, "2 p"], float] | None:
    """The texels on which a recorded figure steps, left (+x in `standing`) and right, and how far they move in a frame.

    Soles are what most often lies still close to the ground while the root moves; hems and hair do not. `texels` are
    relative to `roots`, metres. None for a figure that does not walk, or whose feet are not to be seen.
    """
    same = sequence[1:] == sequence[:-1]
    travel = np.linalg.norm(np.diff(roots[:, [0, 2]], axis=0), axis=1)
    moving = np.flatnonzero(same & (travel > 0.25 * np.quantile(travel, 0.9)))
    now, then = (texels[moving + k] + roots[moving + k, None] for k in (1, 0))
    shift = np.linalg.norm((now - then)[..., [0, 2]], axis=-1)
    rests = (now[..., 1] < HEIGHT) & (then[..., 1] < HEIGHT) & (shift < 0.2 * SWING)
    often = rests.sum(0)
    sides = []
    for side in (standing[:, 0] > 0, standing[:, 0] < 0):
        best = np.flatnonzero(side)[np.argsort(-often[side], kind="stable")][: POINTS[0]]
        sides.append(best[often[best] >= max(SEEN, OFTEN * often[best].max(initial=0))])
    count = min(map(len, sides))
    if count < POINTS[1]:
        return None
    soles = np.stack([best[:count] for best in sides])
    middles = np.linalg.norm((now[:, soles].mean(2) - then[:, soles].mean(2))[..., [0, 2]], axis=-1)
    standing_still = (now[:, soles, 1].min(2) < HEIGHT) & (then[:, soles, 1].min(2) < HEIGHT) & (middles < SWING)
    # The deviation of which a quarter of all steps (Rayleigh's distribution) are shorter: of the longer steps many are
    # those of feet that swing close to the ground.
    return soles, float(np.quantile(middles[standing_still], 0.25) / np.sqrt(-2 * np.log(0.75)))


def square_root(covariance: Float[np.ndarray, "d d"]) -> Float[np.ndarray, "d d"]:
    """The symmetric square root of a covariance matrix."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
