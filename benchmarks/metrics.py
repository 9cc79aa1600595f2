"""Every metric beside its oracle, and what it costs for a whole evaluation on this machine.

    python -m benchmarks.metrics                  # needs the weights: python -m avatarjax.metrics.pretrained
    python -m benchmarks.metrics --vgg-pairs 800  # measure VGG's LPIPS in full instead of from 16 pairs

First table: largest differences from an independent computation of the same number, on photographs that scikit-image
carries and on random data. LPIPS beside torch itself: tests/metrics/test_lpips.py; FVD's network:
`python -m benchmarks.fvd`. Second table: 200 frames of 256x256 in four views, medians after a first call that compiles.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import jax
import numpy as np
import scipy.linalg
import scipy.stats
from skimage import metrics as oracle

from avatarjax.metrics import drift, environment, fvd, i3d, image, lpips, motion
from avatarjax.metrics import statistics as significance
from tests.metrics.pictures import LPIPS, pairs

FRAMES, VIEWS, SIZE, RUNS = 200, 4, 256, 3


def accuracy() -> list[tuple[str, str, float, str]]:
    """Rows of metric, oracle, largest difference, and on what."""
    before, after = pairs()
    photographs = "3 photographs, 64x64"
    psnr = [oracle.peak_signal_noise_ratio(a, b, data_range=1) for a, b in zip(before, after, strict=True)]
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "channel_axis": -1}
    ssim = [
        oracle.structural_similarity(a.astype(np.float64), b.astype(np.float64), data_range=1, **options)
        for a, b in zip(before, after, strict=True)
    ]
    rows = [
        ("PSNR", "scikit-image", _largest(image.psnr(before, after), psnr), f"{photographs} (dB)"),
        ("SSIM", "scikit-image", _largest(image.ssim(before, after), ssim), photographs),
    ]
    for name, known in LPIPS.items():
        found = lpips.distance(lpips.load(name), before, after)
        rows.append((f"LPIPS ({name})", "lpips 0.1.4 in float64", _largest(found, known), photographs))
    rng = np.random.default_rng(0)
    a, b = (rng.normal(size=(900, 40)) @ rng.normal(size=(40, 40)) for _ in range(2))
    first, second = np.cov(a.T), np.cov(b.T)
    root = scipy.linalg.sqrtm(first @ second).real
    true = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(first + second - 2 * root)
    rows.append(("Fréchet distance", "scipy.linalg.sqrtm", fvd.frechet_distance(a, b) / true - 1, "relative, 40-d"))
    t = np.arange(60)[:, None, None] / 30
    fall = np.broadcast_to(-0.5 * 9.81 * t**2, (60, 5, 3))
    error = motion.motion_error(fall, np.zeros_like(fall)) - 9.81 / 900 * np.sqrt(15)
    rows.append(("motion error", "free fall, g / fps^2", error, "metres"))
    x, y = rng.normal(size=(2, 30))
    test = significance.paired_t_test(x, y)
    exact = 2 * scipy.stats.t.sf(abs((x - y).mean() / (x - y).std(ddof=1) * np.sqrt(30)), 29)
    rows.append(("paired t-test, p", "Student's formula", test.p - exact, "30 pairs"))
    points = rng.normal(size=(2, 50, 100, 3)).astype(np.float32)
    brute = [np.sqrt(((f - points[1]) ** 2).sum(-1).mean(-1)).min() for f in points[0]]
    rows.append(("drift", "all pairs in NumPy", _largest(drift.nearest_distance(*points), brute), "50 x 50 frames"))
    return rows


def costs(vgg_pairs: int) -> list[tuple[str, str, float]]:
    """Rows of metric, how much of it was timed, and seconds for FRAMES frames in VIEWS views."""
    rng = np.random.default_rng(0)
    count = FRAMES * VIEWS
    a = rng.random((count, SIZE, SIZE, 3), np.float32)
    b = np.clip(a + 0.1 * rng.standard_normal(a.shape, np.float32), 0, 1)
    rows = [
        (n, f"{count} pairs", _seconds(lambda f=f: f(a, b))) for n, f in (("PSNR", image.psnr), ("SSIM", image.ssim))
    ]
    alex, vgg = lpips.load("alex"), lpips.load("vgg")
    rows.append(("LPIPS (alex)", f"{count} pairs", _seconds(lambda: lpips.distance(alex, a, b))))
    some = a[:vgg_pairs], b[:vgg_pairs]
    taken = _seconds(lambda: lpips.distance(vgg, *some)) * count / vgg_pairs
    rows.append(("LPIPS (vgg)", f"{vgg_pairs} pairs, scaled", taken))
    video = (255 * a.reshape(VIEWS, FRAMES, SIZE, SIZE, 3)).astype(np.uint8)
    network, found = i3d.load(), []

    def features():
        found.append(fvd.features(network, video, progress=False))

    features()
    clips = found[0].shape[0] * found[0].shape[1]
    rows.append(("FVD, features of one side", f"{clips} clips", _seconds(features, runs=1, warm=False)))
    rows.append(
        ("FVD, distance and interval", f"{clips} clips a side", _seconds(lambda: fvd.distance(found[0], found[0] + 1)))
    )
    return rows


def _largest(found: jax.Array | np.ndarray, expected: list[float]) -> float:
    return float(np.abs(np.asarray(found, np.float64) - np.asarray(expected)).max())


def _seconds(work: Callable[[], object], runs: int = RUNS, warm: bool = True) -> float:
    if warm:
        jax.block_until_ready(work())
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vgg-pairs", type=int, default=16, help="pairs with which VGG's LPIPS is timed")
    args = parser.parse_args()
    print("; ".join(f"{k}: {v}" for k, v in environment.describe().items()))
    print("\n| metric | oracle | largest difference | on |\n|---|---|---|---|")
    for metric, by, difference, on in accuracy():
        print(f"| {metric} | {by} | {abs(difference):.1e} | {on} |", flush=True)
    print(f"\n| {FRAMES} frames of {SIZE}x{SIZE} in {VIEWS} views | timed | seconds |\n|---|---|---|")
    for metric, timed, taken in costs(args.vgg_pairs):
        print(f"| {metric} | {timed} | {taken:.2f} |", flush=True)


if __name__ == "__main__":
    main()
