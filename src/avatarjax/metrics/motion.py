"""Does a body move as it should? Acceleration errors of joints, and the frames in which motion spikes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from avatarjax.metrics import checks

# A median absolute deviation times this is the standard deviation of a normal distribution.
_NORMAL = 1.4826
SPIKE_DEVIATIONS = 3.0


def acceleration_errors(
    predicted: Float[np.ndarray, "f j 3"], truth: Float[np.ndarray, "g k 3"]
) -> Float[np.ndarray, " t"]:
    """Error (f - 2,) of each inner frame's joint accelerations (SMAD C.3): the norm over all 3 j coordinates together.

    An acceleration is the second difference x[t + 1] - 2 x[t] + x[t - 1], so the unit is that of the joints per frame
    squared; entry k belongs to frame k + 1. As printed, the norm grows with the number of joints: compare only
    skeletons of as many joints, and say how many. Raises ValueError for shapes that differ, fewer than three frames, or
    joints that are not finite.
    """
    return np.linalg.norm(_difference(predicted, truth).reshape(len(predicted) - 2, -1), axis=1)


def motion_error(predicted: Float[np.ndarray, "f j 3"], truth: Float[np.ndarray, "g k 3"]) -> float:
    """The mean of `acceleration_errors` over the inner frames (SMAD C.3)."""
    return float(acceleration_errors(predicted, truth).mean())


def joint_acceleration_errors(
    predicted: Float[np.ndarray, "f j 3"], truth: Float[np.ndarray, "g k 3"]
) -> Float[np.ndarray, " t"]:
    """Error (f - 2,) of each inner frame as the mean over joints of each joint's own norm (Kanazawa et al. 2019).

    This is the usual "acceleration error", in mm per frame squared for joints in mm. It does not depend on the number
    of joints.
    """
    return np.linalg.norm(_difference(predicted, truth), axis=-1).mean(axis=1)


def accelerations(joints: Float[np.ndarray, "f j 3"]) -> Float[np.ndarray, " t"]:
    """Acceleration (f - 2,) of each inner frame, mean over joints: what `joint_acceleration_errors` gives against a
    figure at rest. It shows spikes of a rollout for which there is no truth."""
    return joint_acceleration_errors(joints, np.zeros_like(joints))


def spike_threshold(reference_errors: Float[np.ndarray, " t"]) -> float:
    """The error above which a frame counts as a spike: median + 3 x 1.4826 MAD of a reference method's errors.

    The paper shows spikes (SMAD Fig. 6) and gives no threshold, this one is ours. Take it from one method, the
    reference, and use the same value for every method compared. Raises ValueError for errors that are not finite.
    """
    errors = checks.finite("reference_errors", reference_errors, (None,))
    median = np.median(errors)
    return float(median + SPIKE_DEVIATIONS * _NORMAL * np.median(np.abs(errors - median)))


def spikes(errors: Float[np.ndarray, " t"], threshold: float) -> Bool[np.ndarray, " t"]:
    """Which frames' errors lie above a `spike_threshold`; the mean is the share of spikes."""
    if not np.isfinite(threshold):
        raise ValueError(f"the threshold must be finite, got {threshold}: take it from spike_threshold")
    return checks.finite("errors", errors, (None,)) > threshold


def nearest_correlation(windows: Float[np.ndarray, "w d"], known: Float[np.ndarray, "k d"]) -> Float[np.ndarray, " w"]:
    """The highest normalised cross-correlation, -1 to 1, of each window of poses with any known one (SMAD D.4, Fig. J).

    A window is a stretch of poses as one vector; give every place at which a known one may begin, and the correlation
    is the highest over shifts in time too. Both are taken about the mean of the known ones; a window that is that mean
    is like none, 0. Raises ValueError for lengths that differ, and numbers that are not finite.
    """
    known = checks.finite("known", known, (None, None))
    windows = checks.finite("windows", windows, (None, known.shape[1]))
    mean = known.mean(axis=0)

    def unit(values):
        centred = values - mean
        return centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), np.finfo(np.float64).tiny)

    return (unit(windows) @ unit(known).T).max(axis=1)


def _difference(predicted: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Second differences (f - 2, j, 3) of the error: differences are linear."""
    truth = checks.finite("truth", truth, (None, None, 3))
    predicted = checks.finite("predicted", predicted, truth.shape)
    if len(truth) < 3:
        raise ValueError(f"an acceleration needs three frames, got {len(truth)}")
    return np.diff(predicted - truth, n=2, axis=0)
