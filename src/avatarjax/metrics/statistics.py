"""How sure a number is: bootstrap intervals of means, over groups where values are correlated, and paired t-tests."""

from __future__ import annotations

import math
import typing

import numpy as np
import scipy.stats
from jaxtyping import Float, Shaped

from avatarjax.metrics import checks

RESAMPLES = 2000


class Estimate(typing.NamedTuple):
    """A mean of `n` values and the bounds of its confidence interval; they are NaN where there is only one value, or
    only one group of values. `groups` is the number of groups that were drawn, None where each value was."""

    mean: float
    low: float
    high: float
    n: int
    groups: int | None = None

    def __format__(self, spec: str) -> str:
        """The mean and, in brackets, its interval, each in the format `spec` (default .4g): 12.4 [11.8, 13.1]."""
        spec = spec or ".4g"
        if math.isnan(self.low):
            return f"{self.mean:{spec}} (n = {self.count})"
        return f"{self.mean:{spec}} [{self.low:{spec}}, {self.high:{spec}}]"

    def __str__(self) -> str:
        return format(self, "")

    @property
    def count(self) -> str:
        """How many values, and in how many groups."""
        return str(self.n) if self.groups is None else f"{self.n} in {self.groups}"


class PairedTest(typing.NamedTuple):
    """A two-sided paired t-test: statistic, p-value, degrees of freedom, and the mean of a - b with its interval."""

    t: float
    p: float
    degrees: int
    difference: Estimate


def bootstrap(values: typing.Any, groups: typing.Any = None, *, confidence: float = 0.95, seed: int = 0) -> Estimate:
    """The mean of values of any shape and its bootstrap interval.

    Independent values are resampled one by one (bias-corrected and accelerated, Efron 1987). With `groups`, one label
    a value, whole groups are resampled instead and the interval is that of expanded percentiles (cluster bootstrap,
    Field and Welsh 2007; `expanded_tails`): frames of one sequence are correlated, and counting them as independent
    makes an interval too narrow. That of fewer than about ten single values is too narrow as well. Equal values have
    an interval of no width; of one value or one group nothing is known, and the bounds are NaN. The same seed gives
    the same bounds.

    Raises ValueError for no values, values that are not finite, labels of another number, or a confidence outside
    (0, 1).
    """
    sample = checks.finite("values", np.ravel(np.asarray(values, np.float64)), (None,))
    checks.fraction("confidence", confidence)
    mean = float(sample.mean())
    if groups is not None:
        return _clustered(sample, np.ravel(groups), confidence, seed)
    if len(sample) == 1:
        return Estimate(mean, math.nan, math.nan, 1)
    if np.ptp(sample) == 0:
        return Estimate(mean, mean, mean, len(sample))
    found = scipy.stats.bootstrap(
        (sample,),
        np.mean,
        n_resamples=RESAMPLES,
        batch=100,
        confidence_level=confidence,
        random_state=np.random.default_rng(seed),
    ).confidence_interval
    return Estimate(mean, float(found.low), float(found.high), len(sample))


def _clustered(
    sample: Float[np.ndarray, " n"], labels: Shaped[np.ndarray, " m"], confidence: float, seed: int
) -> Estimate:
    if len(labels) != len(sample):
        raise ValueError(f"every value needs the label of its group: {len(sample)} values, {len(labels)} labels")
    _, group = np.unique(labels, return_inverse=True)
    sizes = np.bincount(group)
    sums = np.bincount(group, sample)
    count, mean = len(sizes), float(sample.mean())
    if count == 1:
        return Estimate(mean, math.nan, math.nan, len(sample), 1)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    low, high = np.percentile((drawn @ sums) / (drawn @ sizes), expanded_tails(confidence, count))
    return Estimate(mean, float(low), float(high), len(sample), count)


def expanded_tails(confidence: float, count: int, fitted: int = 1) -> tuple[float, float]:
    """The lower and upper percentile of bootstrap means of `count` independent pieces that bound a confidence interval.

    Plain percentiles are too narrow for few pieces: they know neither the degrees of freedom that `fitted` parameters
    take nor Student's wider tails. These do (Hesterberg 2015, "What Teachers Should Know about the Bootstrap").
    """
    degrees = count - fitted
    quantile = scipy.stats.t.ppf((1 + confidence) / 2, degrees) * math.sqrt(count / degrees)
    tail = 100 * float(scipy.stats.norm.sf(quantile))
    return tail, 100 - tail


def paired_t_test(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " m"], *, confidence: float = 0.95) -> PairedTest:
    """Whether two methods differ on the same n items, two-sided (SMAD D.3, which tests SSIM at p = 0.05).

    Equal differences have no spread to judge by: t is infinite and p is 0, or t is 0 and p is 1 where all are zero.
    With one pair t, p and the interval are NaN. Raises ValueError for numbers of values that differ, or values that are
    not finite.
    """
    first = checks.finite("a", a, (None,))
    second = checks.finite("b", b, (len(first),))
    checks.fraction("confidence", confidence)
    difference = first - second
    n, mean = len(difference), float(difference.mean())
    if n == 1:
        return PairedTest(math.nan, math.nan, 0, Estimate(mean, math.nan, math.nan, 1))
    if np.ptp(difference) == 0:
        t, p = (0.0, 1.0) if mean == 0 else (math.copysign(math.inf, mean), 0.0)
        return PairedTest(t, p, n - 1, Estimate(mean, mean, mean, n))
    found = scipy.stats.ttest_rel(first, second)
    low, high = found.confidence_interval(confidence)
    interval = Estimate(mean, float(low), float(high), n)
    return PairedTest(float(found.statistic), float(found.pvalue), n - 1, interval)
