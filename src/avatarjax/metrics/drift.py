"""Does a long rollout stay near what it learned? Distance to the nearest training frame, and the trend of a curve."""

from __future__ import annotations

import typing

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.metrics import checks, statistics

RESAMPLES = 1000


class Trend(typing.NamedTuple):
    """A straight line through a curve (f,): slope a frame, intercept, and how sure they are.

    slope_interval is (low, high); line, lower and upper (f,) are the fitted line and its pointwise confidence band;
    std is the standard deviation of the curve about the line, whose band UNICA Fig. 6 shades (line - std, line + std).
    """

    slope: float
    intercept: float
    slope_interval: tuple[float, float]
    line: Float[np.ndarray, " f"]
    lower: Float[np.ndarray, " f"]
    upper: Float[np.ndarray, " f"]
    std: float


def trend(values: Float[np.ndarray, " f"], *, block: int = 50, confidence: float = 0.95, seed: int = 0) -> Trend:
    """The least-squares line through f values in order of time, with the interval of its slope and its band.

    Neighbouring frames resemble each other, so that the usual formula for independent errors would be far too sure.
    Here whole blocks of `block` successive residuals are drawn (circular block bootstrap, Politis and Romano 1992), and
    the bounds are expanded percentiles over the lines refitted to them. A block should be several times longer than the
    time over which values are correlated, and there should be ten or more blocks. Raises ValueError for values that are
    not finite or fewer than three blocks of them.
    """
    values = checks.finite("values", values, (None,))
    checks.fraction("confidence", confidence)
    count = len(values)
    if block < 1 or count < 3 * block:
        raise ValueError(f"a trend needs three blocks of {block} frames, got {count} frames: shorten the block")
    times = np.arange(count) - (count - 1) / 2
    spread = (times**2).sum()
    mean, slope = values.mean(), float(times @ values / spread)
    line = mean + slope * times
    residuals = values - line
    blocks = -(-count // block)
    starts = np.random.default_rng(seed).integers(0, count, (RESAMPLES, blocks))
    slopes, shifts = np.empty(RESAMPLES), np.empty(RESAMPLES)
    for k, first in enumerate(starts):
        drawn = residuals[(first[:, None] + np.arange(block)).ravel()[:count] % count]
        slopes[k], shifts[k] = slope + times @ drawn / spread, drawn.mean()
    tails = statistics.expanded_tails(confidence, count // block, fitted=2)
    low, high = np.percentile(slopes, tails)
    band = [np.percentile(mean + shifts + t * slopes, tails) for t in times]
    lower, upper = np.array(band).T
    return Trend(
        slope,
        float(line[0]),
        (float(low), float(high)),
        line,
        lower,
        upper,
        float(residuals.std(ddof=2)),
    )


def nearest_distance(
    frames: Float[np.ndarray, "f t 3"], training: Float[np.ndarray, "n s 3"], *, chunk: int = 256
) -> Float[np.ndarray, " f"]:
    """Root mean square distance of each frame's points to those of the nearest training frame, in the same unit.

    Both are root-relative. Raises ValueError for frames that are not finite, for "near" would then mean nothing, and
    for another number of points.
    """
    checks.finite("training", training[:1], (1, None, 3))
    checks.finite("frames", frames, (None, training.shape[1], 3), None)
    known = jnp.asarray(training.reshape(len(training), -1))
    squared = jnp.sum(known**2, axis=1)
    flat = frames.reshape(len(frames), -1)
    parts = [_nearest(jnp.asarray(flat[k : k + chunk]), known, squared) for k in range(0, len(flat), chunk)]
    return np.concatenate([np.asarray(part) for part in parts]) / np.float32(np.sqrt(frames.shape[1]))


@jax.jit
def _nearest(block: Float[Array, "b d"], known: Float[Array, "n d"], squared: Float[Array, " n"]) -> Float[Array, " b"]:
    distance = jnp.sum(block**2, axis=1)[:, None] + squared[None] - 2 * block @ known.T
    return jnp.sqrt(jnp.maximum(jnp.min(distance, axis=1), 0))
