"""Photometric losses against scikit-image."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from skimage.metrics import structural_similarity

from avatarjax.splat import l1, ssim


def pair(h, w, c=3, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(size=(h, w, c))
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)
    return jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)


@pytest.mark.parametrize("size", [(11, 11), (32, 20), (17, 64, 1)], ids=str)
def test_ssim_matches_scikit_image(size):
    a, b = pair(*size)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "channel_axis": -1}
    expected = structural_similarity(np.asarray(a, np.float64), np.asarray(b, np.float64), data_range=1.0, **options)
    np.testing.assert_allclose(ssim(a, b), expected, atol=1e-5)


def test_ssim_of_equal_images_is_one():
    a, _ = pair(16, 16)
    np.testing.assert_allclose(ssim(a, a), 1.0, atol=1e-6)


def test_ssim_gradient_matches_finite_differences():
    with jax.enable_x64(True):
        a, b = (jnp.asarray(np.asarray(x), jnp.float64) for x in pair(14, 13))
        check_grads(jax.jit(ssim), (a, b), order=1, modes=["rev"], atol=1e-6, rtol=1e-6)


def test_ssim_refuses_an_image_smaller_than_its_window():
    with pytest.raises(ValueError, match="at least 11x11"):
        ssim(*pair(10, 20))


def test_ssim_under_vmap_is_the_ssim_of_each_pair():
    pairs = [pair(12, 15, seed=seed) for seed in range(3)]
    a, b = (jnp.stack(x) for x in zip(*pairs, strict=True))
    np.testing.assert_allclose(jax.vmap(ssim)(a, b), [ssim(*p) for p in pairs], atol=1e-6)


def test_l1_is_the_mean_absolute_difference():
    a, b = pair(4, 5)
    np.testing.assert_allclose(l1(a, b), np.abs(np.asarray(a) - np.asarray(b)).mean(), rtol=1e-6)
