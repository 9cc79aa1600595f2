"""PSNR and SSIM are scikit-image's, over any batch axes, and refuse what they would silently misjudge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import metrics as oracle

from avatarjax.metrics import image
from tests.metrics.pictures import pairs


@pytest.fixture(scope="module")
def pictures():
    rng = np.random.default_rng(1)
    before, after = pairs()
    noise = rng.random((2, 64, 64, 3)).astype(np.float32)
    flat = np.full((1, 64, 64, 3), 0.25, np.float32)
    return np.concatenate([before, noise, flat]), np.concatenate([after, noise[::-1], flat + 0.5])


def test_psnr_is_that_of_scikit_image(pictures):
    expected = [oracle.peak_signal_noise_ratio(a, b, data_range=1.0) for a, b in zip(*pictures, strict=True)]
    np.testing.assert_allclose(image.psnr(*pictures), expected, atol=1e-5)


def test_psnr_in_a_mask_is_that_of_its_pixels_alone(pictures):
    inside = np.random.default_rng(2).random((len(pictures[0]), *pictures[0].shape[1:3], 1)) < 0.3
    squared = [np.mean((a - b)[m[..., 0]] ** 2) for a, b, m in zip(*pictures, inside, strict=True)]
    found = image.masked_psnr(*pictures, inside.astype(np.float32))
    np.testing.assert_allclose(found, -10 * np.log10(squared), atol=1e-4)


def test_ssim_is_that_of_scikit_image(pictures):
    def reference(a, b):
        wide = a.astype(np.float64), b.astype(np.float64)
        options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
        return oracle.structural_similarity(*wide, data_range=1.0, channel_axis=-1, **options)

    expected = [reference(a, b) for a, b in zip(*pictures, strict=True)]
    np.testing.assert_allclose(image.ssim(*pictures), expected, atol=1e-5)


@pytest.mark.parametrize("metric", [image.psnr, image.ssim])
@pytest.mark.parametrize("batch", [(), (2,), (2, 1), (0,)])
def test_every_batch_axis_is_kept(metric, batch):
    rng = np.random.default_rng(0)
    a, b = (rng.random((*batch, 12, 16, 3), np.float32) for _ in range(2))
    found = metric(a, b)
    assert found.shape == batch
    for index in np.ndindex(batch):
        np.testing.assert_allclose(found[index], metric(a[index], b[index]), atol=1e-5)


def test_equal_images_are_infinitely_and_fully_alike(pictures):
    assert np.isinf(image.psnr(pictures[0], pictures[0])).all()
    np.testing.assert_allclose(image.ssim(pictures[0], pictures[0]), 1, atol=1e-6)


def test_a_known_noise_has_a_known_psnr():
    assert float(image.psnr(np.zeros((8, 8, 3), np.float32), np.full((8, 8, 3), 0.1, np.float32))) == pytest.approx(20)


@pytest.mark.parametrize("metric", [image.psnr, image.ssim])
def test_they_are_differentiable_under_jit(metric, pictures):
    a, b = (0.9 * jnp.asarray(x[0]) + 0.05 for x in pictures)
    slope = jax.jit(jax.grad(metric))(a, b)
    step = 1e-3 * jnp.sign(slope)
    np.testing.assert_allclose(metric(a + step, b) - metric(a - step, b), 2 * jnp.sum(slope * step), rtol=0.02)


@pytest.mark.parametrize("metric", [image.psnr, image.ssim])
def test_bad_images_are_refused(metric):
    good = np.zeros((2, 16, 16, 3), np.float32)
    with pytest.raises(ValueError, match="different shapes"):
        metric(good, good[:1])
    with pytest.raises(ValueError, match=r"within \[0, 1\]"):
        metric(good, 255 * np.ones_like(good))
    nan = good.copy()
    nan[0, 0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="finite"):
        metric(nan, good)
