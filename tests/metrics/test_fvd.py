"""FVD: the distance against scipy's matrix root and closed forms, clips and windows with small stand-ins for I3D."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from avatarjax.metrics import fvd


def mean_colours(params, clips):
    """Stands in for I3D: the mean of each clip's first, middle and last frame."""
    return params * jnp.mean(clips[:, ::7], axis=(2, 3, 4))


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def numbered(views, frames, size=4):
    """Videos whose every frame is grey of its own brightness."""
    grey = np.arange(views * frames, dtype=np.uint8).reshape(views, frames, 1, 1, 1)
    return np.broadcast_to(grey, (views, frames, size, size, 3))


def bilinear(image, size):
    """An image (h, w, c) resized to (size, size, c) between pixel centres, in float64, pixel by pixel."""
    out = np.empty((size, size, image.shape[2]))
    h, w, _ = image.shape
    for i in range(size):
        for j in range(size):
            y = np.clip((i + 0.5) * h / size - 0.5, 0, h - 1)
            x = np.clip((j + 0.5) * w / size - 0.5, 0, w - 1)
            top, left = int(y), int(x)
            below, right = min(top + 1, h - 1), min(left + 1, w - 1)
            across = [(1 - (x - left)) * image[row, left] + (x - left) * image[row, right] for row in (top, below)]
            out[i, j] = (1 - (y - top)) * across[0] + (y - top) * across[1]
    return out


@pytest.mark.parametrize("size", [(5, 3), (300, 260)])
def test_frames_are_resized_between_pixel_centres(rng, size):
    frame = rng.uniform(size=(*size, 3)).astype(np.float32)
    np.testing.assert_allclose(fvd.preprocess(frame), 2 * bilinear(frame, 224) - 1, atol=1e-4)


def test_bytes_and_floats_are_the_same_frames(rng):
    frames = rng.integers(0, 256, (2, 3, 224, 224, 3), dtype=np.uint8)
    np.testing.assert_allclose(fvd.preprocess(frames), frames / 127.5 - 1, atol=1e-6)
    np.testing.assert_allclose(fvd.preprocess(frames / 255), frames / 127.5 - 1, atol=1e-6)


def test_resizing_commutes_with_a_mirror(rng):
    frame = rng.uniform(size=(100, 301, 3)).astype(np.float32)
    np.testing.assert_allclose(fvd.preprocess(frame[:, ::-1]), fvd.preprocess(frame)[:, ::-1], atol=1e-5)


@pytest.mark.parametrize(
    "frame, message",
    [
        (np.zeros((4, 4, 4), np.uint8), "RGB"),
        (np.zeros((0, 4, 3), np.uint8), "empty"),
        (np.zeros((4, 4, 3), np.int32), "uint8, or float"),
        (np.full((4, 4, 3), 255.0), r"\[0, 1\]"),
        (np.full((4, 4, 3), -0.1), r"\[0, 1\]"),
        (np.full((4, 4, 3), np.nan), r"\[0, 1\]"),
    ],
)
def test_other_frames_are_refused(frame, message):
    with pytest.raises(ValueError, match=message):
        fvd.preprocess(frame)


def test_two_hundred_frames_are_twelve_clips_and_eight_are_left_over():
    starts, dropped = fvd.clip_starts(200)
    np.testing.assert_array_equal(starts, 16 * np.arange(12))
    assert dropped == 8


@pytest.mark.parametrize("batch", [1, 2, 8])
def test_features_are_those_of_each_view_s_clips_in_order(batch):
    videos = numbered(2, 50)
    found = fvd.features(127.5, videos, network=mean_colours, batch=batch, progress=False)
    starts = np.array([[0, 16, 32], [50, 66, 82]])
    np.testing.assert_allclose(found, starts[..., None] + [0, 7, 14] - 127.5, atol=1e-4)


def test_features_of_chosen_clips():
    found = fvd.features(127.5, numbered(1, 40), np.array([3, 24]), network=mean_colours, progress=False)
    np.testing.assert_allclose(found[0, :, 0], [3 - 127.5, 24 - 127.5], atol=1e-4)


@pytest.mark.parametrize("starts", [[-1], [25], []])
def test_clips_outside_the_video_are_refused(starts):
    with pytest.raises(ValueError, match="between frames 0 and 24"):
        fvd.features(1.0, numbered(1, 40), np.array(starts, int), network=mean_colours, progress=False)


def test_a_batch_of_nothing_is_refused():
    with pytest.raises(ValueError, match="batch"):
        fvd.features(1.0, numbered(1, 16), network=mean_colours, batch=0, progress=False)


def test_features_that_are_not_finite_are_refused():
    with pytest.raises(ValueError, match="not finite"):
        fvd.features(np.nan, numbered(1, 16), network=mean_colours, progress=False)


def test_short_videos_are_refused():
    with pytest.raises(ValueError, match="at least 16 frames"):
        fvd.features(1.0, numbered(1, 15), network=mean_colours, progress=False)


@pytest.mark.parametrize("n, m", [(60, 90), (9, 400)])
def test_the_distance_is_scipy_s(rng, n, m):
    a, b = rng.normal(size=(n, 8)) @ rng.normal(size=(8, 8)), rng.normal(size=(m, 8)) @ rng.normal(size=(8, 8)) + 1
    root = scipy.linalg.sqrtm(np.cov(a.T) @ np.cov(b.T))
    shift = np.sum((a.mean(0) - b.mean(0)) ** 2)
    expected = shift + np.trace(np.cov(a.T) + np.cov(b.T) - 2 * np.real(root))
    np.testing.assert_allclose(fvd.frechet_distance(a, b), expected, rtol=1e-9)


def test_the_distance_of_fewer_features_than_dimensions(rng):
    # Two points on a line each: the Gaussians have one axis, of standard deviations 3 sqrt(2) and 1 sqrt(2).
    along = rng.normal(size=50)
    along /= np.linalg.norm(along)
    a, b = np.stack([-3 * along, 3 * along]), np.stack([along, -along])
    np.testing.assert_allclose(fvd.frechet_distance(a, b), 2 * (3 - 1) ** 2, rtol=1e-12)


def test_the_distance_of_commuting_covariances_is_a_closed_form(rng):
    a = rng.normal(size=(30, 5))
    scale = np.array([2.0, 0.5, 1.0, 3.0, 0.1])
    q, _ = np.linalg.qr(a - a.mean(0))
    white = q * np.sqrt(29)
    np.testing.assert_allclose(fvd.frechet_distance(white, white * scale), np.sum((scale - 1) ** 2), rtol=1e-10)


@pytest.mark.parametrize("n", [5, 40])
def test_a_shift_counts_with_its_square_and_no_shift_with_nothing(rng, n):
    a, shift = rng.normal(size=(n, 20)), rng.normal(size=20)
    assert fvd.frechet_distance(a, rng.permutation(a)) < 1e-12
    np.testing.assert_allclose(fvd.frechet_distance(a, a + shift), shift @ shift, rtol=1e-9)


@pytest.mark.parametrize(
    "a, b, message",
    [
        (np.zeros((1, 3)), np.zeros((4, 3)), "at least two"),
        (np.zeros((4, 3)), np.zeros((4, 2)), r"\(any, 3\)"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), "finite"),
    ],
)
def test_other_features_are_refused(a, b, message):
    with pytest.raises(ValueError, match=message):
        fvd.frechet_distance(a, b)


def test_views_are_measured_apart_and_pooled(rng):
    a, b = rng.normal(size=(4, 12, 6)), rng.normal(size=(4, 10, 6)) + 1
    found = fvd.distance(a, b)
    apart = [fvd.frechet_distance(x, y) for x, y in zip(a, b, strict=True)]
    np.testing.assert_allclose([found.per_view_mean, *found.per_view], [np.mean(apart), *apart])
    np.testing.assert_allclose(found.pooled, fvd.frechet_distance(a.reshape(48, 6), b.reshape(40, 6)))
    assert (found.generated_clips, found.reference_clips) == (12, 10)
    assert found.low < found.pooled < found.high


def test_the_interval_is_as_wide_as_the_numbers_scatter(rng):
    def draw(shift):
        # Four views that see much of the same.
        return 0.8 * rng.normal(size=(1, 12, 6)) + 0.6 * rng.normal(size=(4, 12, 6)) + shift

    found = [fvd.distance(draw(1.0), draw(0.0)) for _ in range(150)]
    scatter = np.std([x.pooled for x in found])
    claimed = np.mean([x.high - x.pooled for x in found]) / 1.96
    assert 0.8 < claimed / scatter < 1.5


def test_the_interval_is_unknown_where_too_few_clips_are_left(rng):
    assert np.isnan(fvd.distance(rng.normal(size=(1, 2, 3)), rng.normal(size=(1, 9, 3))).high)


def test_videos_of_other_views_are_refused(rng):
    with pytest.raises(ValueError, match="shape"):
        fvd.distance(rng.normal(size=(4, 12, 6)), rng.normal(size=(3, 12, 6)))


@pytest.mark.parametrize("stride", [10, 16])
def test_a_window_s_value_is_that_of_the_window_alone(rng, stride):
    rollout = rng.integers(0, 256, (2, 80, 4, 4, 3), dtype=np.uint8)
    reference = rng.normal(size=(2, 3, 3))
    found = fvd.sliding(1.0, rollout, reference, window=40, stride=stride, network=mean_colours, progress=False)
    np.testing.assert_array_equal(found.starts, np.arange(0, 41, stride))
    for start, value in zip(found.starts, found.values, strict=True):
        alone = fvd.features(1.0, rollout[:, start : start + 40], network=mean_colours, progress=False)
        np.testing.assert_allclose(value.pooled, fvd.distance(alone, reference).pooled)


def test_windows_share_clips_at_a_stride_of_sixteen():
    starts, clips, index = fvd.sliding_clips(2000, stride=16)
    assert (len(starts), len(clips), index.shape) == (113, 124, (113, 12))


@pytest.mark.parametrize("frames, window, stride", [(199, 200, 10), (200, 31, 10), (200, 100, 0)])
def test_windows_that_do_not_fit_are_refused(frames, window, stride):
    with pytest.raises(ValueError, match="need a stride"):
        fvd.sliding_clips(frames, window=window, stride=stride)
