"""Photometric losses between images (h, w, c) in [0, 1]; `jax.vmap` for batches."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
_offsets = np.arange(_WINDOW) - _WINDOW // 2
_KERNEL = np.exp(-0.5 * (_offsets / _SIGMA) ** 2)
_KERNEL = [float(k) for k in _KERNEL / _KERNEL.sum()]


def l1(a: Float[Array, "*b h w c"], b: Float[Array, "*b h w c"]) -> Float[Array, ""]:
    """Mean absolute difference."""
    return jnp.mean(jnp.abs(a - b))


def ssim(a: Float[Array, "h w c"], b: Float[Array, "h w c"]) -> Float[Array, ""]:
    """Structural similarity (Wang et al. 2004), 1 for equal images: the mean over all whole windows and channels.

    Gaussian window of 11x11 pixels with sigma 1.5, data range 1, population covariances, as
    `skimage.metrics.structural_similarity(gaussian_weights=True, use_sample_covariance=False)`. Raises ValueError for
    an image smaller than the window.
    """
    if min(a.shape[:2]) < _WINDOW:
        raise ValueError(f"ssim needs images of at least {_WINDOW}x{_WINDOW} pixels, got {a.shape[0]}x{a.shape[1]}")
    # Variances about the images' own means: as differences of raw moments float32 would lose them in flat places.
    centre_a, centre_b = (jax.lax.stop_gradient(jnp.mean(x, axis=(0, 1), keepdims=True)) for x in (a, b))
    a, b = a - centre_a, b - centre_b
    means = _blur(jnp.concatenate([a, b, a * a, b * b, a * b], axis=-1))
    mean_a, mean_b, mean_aa, mean_bb, mean_ab = jnp.split(means, 5, axis=-1)
    variances, covariance = mean_aa + mean_bb - mean_a * mean_a - mean_b * mean_b, mean_ab - mean_a * mean_b
    mean_a, mean_b = mean_a + centre_a, mean_b + centre_b
    product, squares = mean_a * mean_b, mean_a * mean_a + mean_b * mean_b
    similarity = (2 * product + _C1) * (2 * covariance + _C2) / ((squares + _C1) * (variances + _C2))
    return jnp.mean(similarity)


@jax.custom_vjp
def _blur(x: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    # Sums of shifted images: XLA's depthwise convolution is eight times as slow on CPU.
    h, w = x.shape[0] - _WINDOW + 1, x.shape[1] - _WINDOW + 1
    x = sum((k * x[i : i + h] for i, k in enumerate(_KERNEL)), jnp.zeros((), x.dtype))
    return sum((k * x[:, i : i + w] for i, k in enumerate(_KERNEL)), jnp.zeros((), x.dtype))


def _blur_bwd(_, cotangent):
    # The window is symmetric, so its transpose is itself; XLA's own gradient of the slices is six times as slow.
    margin = (_WINDOW - 1, _WINDOW - 1)
    return (_blur(jnp.pad(cotangent, (margin, margin, (0, 0)))),)


_blur.defvjp(lambda x: (_blur(x), None), _blur_bwd)
