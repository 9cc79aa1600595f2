"""Fréchet video distance (FVD): how far the clips of rendered videos lie from those of reference videos.

    params = i3d.load()
    fvd.distance(fvd.features(params, generated), fvd.features(params, reference))

Unterthiner et al., "Towards Accurate Generative Models of Video: A New Metric & Challenges", 2018: the Fréchet distance
between two Gaussians, fitted to the logits of I3D (Carreira & Zisserman 2017) for clips of both sides. As UNICA C.4
has it, clips are windows of 16 frames that do not overlap.

FVD of few clips is biased upwards, by much: a Gaussian over 400 dimensions takes thousands of clips to fit, UNICA's
videos give 12 a view. Two numbers compare only where both sides of both have the same numbers of clips.
"""

from __future__ import annotations

import math
import typing
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped
from tqdm import tqdm

from avatarjax.metrics import checks, i3d

CLIP = 16
WINDOW = 200
STRIDE = 10
BATCH = 8
# Standard errors on either side of a normal distribution's middle that hold 95 % of it.
_NORMAL_95 = 1.96


class FVD(typing.NamedTuple):
    """FVD of some views, the mean of which UNICA reports (4.2), and of the clips of all views `pooled`.

    `per_view` (v,); `generated_clips` and `reference_clips` count a view's. `low` and `high` bound the pooled value by
    a normal 95 % interval, its variance from the jackknife that leaves out one time window at a time, in all views
    because they show the same motion, first of the one side, then of the other. The interval tells how much other
    motions of this length would change the number, not how far the bias of few clips has raised it. It takes the two
    sides for independent: of videos that follow each other frame by frame it is too wide. The bounds are NaN where
    leaving out a window leaves fewer than two clips.
    """

    per_view: tuple[float, ...]
    pooled: float
    low: float
    high: float
    generated_clips: int
    reference_clips: int

    @property
    def per_view_mean(self) -> float:
        """The mean over the views."""
        return float(np.mean(self.per_view))


class Sliding(typing.NamedTuple):
    """FVD along a rollout: the first frame (w,) of each window, and the window's FVD."""

    starts: Int[np.ndarray, " w"]
    values: tuple[FVD, ...]


def preprocess(videos: Shaped[np.ndarray, "*b h w c"]) -> Float[Array, "*b 224 224 c"]:
    """RGB frames (..., h, w, 3), uint8 or float in [0, 1], as I3D takes them: 224x224 and in [-1, 1].

    Bilinear between pixel centres, without a filter against aliasing, as TensorFlow 2 and the PyTorch versions of FVD
    resize. TensorFlow 1, which the first FVD code used, put the corners of pixels on each other instead and moved the
    picture by a part of a pixel, so that a mirrored video got other features. Render 224x224 and nothing is resized.

    Raises ValueError for another shape or dtype, values that are not finite, and floats outside [0, 1].
    """
    if videos.ndim < 3 or videos.shape[-1] != 3 or videos.size == 0:
        raise ValueError(f"videos must be RGB frames (..., h, w, 3), not empty, got shape {videos.shape}")
    if videos.dtype != np.uint8:
        if not np.issubdtype(videos.dtype, np.floating):
            raise ValueError(f"videos must be uint8, or float in [0, 1], got {videos.dtype}")
        # Written so that NaN fails too.
        if not (videos.min() >= 0 and videos.max() <= 1):
            raise ValueError(f"float videos must lie in [0, 1], got {videos.min()} to {videos.max()}")
        videos = videos.astype(np.float32)
    return _to_network(jnp.asarray(videos))


@jax.jit
def _to_network(videos: Shaped[Array, "*b h w c"]) -> Float[Array, "*b 224 224 c"]:
    x = videos.astype(jnp.float32) * (2 / 255 if videos.dtype == jnp.uint8 else 2) - 1
    return jax.image.resize(x, (*x.shape[:-3], i3d.SIZE, i3d.SIZE, x.shape[-1]), "bilinear", antialias=False)


def clip_starts(frames: int) -> tuple[Int[np.ndarray, " n"], int]:
    """First frames (n,) of the clips that do not overlap, and the number of frames left over at the end, not used.

    Raises ValueError for fewer frames than a clip's 16.
    """
    if frames < CLIP:
        raise ValueError(f"FVD needs videos of at least {CLIP} frames, got {frames}")
    return np.arange(0, frames - CLIP + 1, CLIP), frames % CLIP


def features(
    params: typing.Any,
    videos: Shaped[np.ndarray, "v f h w c"],
    starts: Int[np.ndarray, " n"] | None = None,
    *,
    network: Callable[[typing.Any, Array], Array] = i3d.logits,
    batch: int | None = None,
    progress: bool = True,
) -> Float[np.ndarray, "v n d"]:
    """What `network` makes of the clips of v views (v, f, h, w, 3), uint8 or float in [0, 1]: (v, n, 400) for I3D.

    Clips begin at the frames `starts`, by default those of `clip_starts`. `batch` is the number of clips computed at a
    time, which changes no result: 8 as in UNICA C.4, but 1 on CPU, where more are no faster. Only a batch is ever
    resized, so `videos` may be a memory map longer than the memory. `network` is a function of parameters and clips
    (b, 16, 224, 224, 3) in [-1, 1].

    Raises ValueError where `preprocess` does, for clips that do not lie in the video, and for features that are not
    finite.
    """
    if videos.ndim != 5 or len(videos) == 0:
        raise ValueError(f"videos must be one or more views (v, f, h, w, 3), got shape {videos.shape}")
    every, dropped = clip_starts(videos.shape[1])
    starts = every if starts is None else np.asarray(starts)
    if len(starts) == 0 or starts.min() < 0 or starts.max() > videos.shape[1] - CLIP:
        raise ValueError(f"clips must begin between frames 0 and {videos.shape[1] - CLIP}, got {starts}")
    if batch is None:
        batch = 1 if jax.default_backend() == "cpu" else BATCH
    if batch < 1:
        raise ValueError(f"batch must be at least 1, got {batch}")
    network, params = jax.jit(network), jax.device_put(params)
    clips = [(view, start) for view in range(len(videos)) for start in starts]
    rows = []
    note = f" ({dropped} of {videos.shape[1]} frames left over)" if starts is every and dropped else ""
    with tqdm(total=len(clips), desc=f"FVD features{note}", unit="clip", disable=not progress) as bar:
        for k in range(0, len(clips), batch):
            chosen = clips[k : k + batch]
            # The last batch is filled up: another size would be compiled anew.
            filled = chosen + chosen[-1:] * (batch - len(chosen))
            frames = preprocess(np.stack([videos[view, start : start + CLIP] for view, start in filled]))
            rows.append(np.asarray(network(params, frames))[: len(chosen)])
            bar.update(len(chosen))
    found = np.concatenate(rows)
    if not np.isfinite(found).all():
        raise ValueError("the network made features that are not finite")
    return found.reshape(len(videos), len(starts), -1)


def frechet_distance(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m e"]) -> float:
    """Squared Fréchet distance between Gaussians fitted to two sets of features (Dowson & Landau 1982).

    |mean a - mean b|^2 + trace(A + B - 2 (A B)^(1/2)) with the unbiased covariances A and B. The last trace is the
    nuclear norm of the product of the centred features: no root of a matrix is taken, so that fewer features than
    dimensions, whose covariances are singular, do no harm. In float64.

    Raises ValueError for fewer than two features on a side, other dimensions, and values that are not finite.
    """
    a = checks.finite("the first features", a, (None, None))
    b = checks.finite("the second features", b, (None, a.shape[1]))
    if min(len(a), len(b)) < 2:
        raise ValueError(f"a covariance needs at least two features on each side, got {len(a)} and {len(b)}")
    shift = a.mean(0) - b.mean(0)
    first, second = _root(a), _root(b)
    overlap = np.linalg.svd(first @ second.T, compute_uv=False).sum()
    return max(float(shift @ shift + (first**2).sum() + (second**2).sum() - 2 * overlap), 0.0)


def _root(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "k d"]:
    """R with R^T R the covariance of x."""
    centred = (x - x.mean(0)) / math.sqrt(len(x) - 1)
    return centred if len(x) <= x.shape[1] else np.linalg.qr(centred)[1]


def distance(generated: Float[np.ndarray, "v n d"], reference: Float[np.ndarray, "w m e"]) -> FVD:
    """FVD between the features of generated and of reference videos of the same views, each in the order of time.

    Raises ValueError for other numbers of views, fewer than two clips a view, and values that are not finite.
    """
    generated = checks.finite("the generated features", generated, (None, None, None))
    reference = checks.finite("the reference features", reference, (len(generated), None, generated.shape[2]))
    pooled = _pooled(generated, reference)
    per_view = tuple(frechet_distance(a, b) for a, b in zip(generated, reference, strict=True))
    variance = _jackknife(lambda kept: _pooled(kept, reference), generated)
    variance += _jackknife(lambda kept: _pooled(generated, kept), reference)
    margin = _NORMAL_95 * math.sqrt(variance)
    return FVD(per_view, pooled, max(pooled - margin, 0.0), pooled + margin, generated.shape[1], reference.shape[1])


def sliding(
    params: typing.Any,
    rollout: Shaped[np.ndarray, "v f h w c"],
    reference: Float[np.ndarray, "v m d"],
    *,
    window: int = WINDOW,
    stride: int = STRIDE,
    **options: typing.Any,
) -> Sliding:
    """FVD of windows of a long rollout (v, f, h, w, 3) against the features of reference videos (UNICA Fig. 6).

    Windows have `window` frames and begin every `stride` frames; each is cut into clips as a video of its own. A clip
    that windows share is computed once: in 2,000 frames UNICA's stride of 10 takes 961 clips a view, one of 16 takes
    124. `options` are those of `features`.

    Raises ValueError for a rollout shorter than a window, a window shorter than two clips, and where `features` and
    `distance` do.
    """
    starts, clips, index = sliding_clips(rollout.shape[1], window=window, stride=stride)
    found = features(params, rollout, clips, **options)
    return Sliding(starts, tuple(distance(found[:, chosen], reference) for chosen in index))


def sliding_clips(
    frames: int, *, window: int = WINDOW, stride: int = STRIDE
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, " n"], Int[np.ndarray, "w c"]]:
    """First frames of the windows (w,), of the clips in any of them (n,), and which clips (w, c) a window has.

    Raises ValueError for a rollout shorter than a window, a window shorter than two clips, or a stride under 1.
    """
    if stride < 1 or window < 2 * CLIP or frames < window:
        raise ValueError(
            f"need a stride of at least 1, a window of at least {2 * CLIP} frames and a rollout of at least a window, "
            f"got stride {stride}, window {window}, rollout {frames}"
        )
    starts = np.arange(0, frames - window + 1, stride)
    needed = starts[:, None] + clip_starts(window)[0]
    clips, index = np.unique(needed, return_inverse=True)
    return starts, clips, index.reshape(needed.shape)


def _pooled(a: Float[np.ndarray, "v n d"], b: Float[np.ndarray, "v m d"]) -> float:
    return frechet_distance(a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1]))


def _jackknife(value: Callable[[np.ndarray], float], sample: Float[np.ndarray, "v n d"]) -> float:
    """Variance of `value` by leaving out each of the n time windows once; NaN where too little would be left."""
    views, n, _ = sample.shape
    if views * (n - 1) < 2:
        return math.nan
    left = [value(np.delete(sample, k, axis=1)) for k in range(n)]
    return (n - 1) * float(np.var(left))
