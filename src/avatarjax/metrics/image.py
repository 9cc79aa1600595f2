"""How alike two pictures are, by pixels and by structure: PSNR and SSIM of images in [0, 1]."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from avatarjax.splat import losses

Images = Float[Array | np.ndarray, "... _ _ _"]


def psnr(a: Images, b: Images) -> Float[Array, "..."]:
    """Peak signal-to-noise ratio in dB of images (..., h, w, c) in [0, 1]: -10 log10 of the mean squared difference.

    Infinite for equal images. Raises ValueError for different shapes, and outside jit also for NaN and values outside
    [0, 1]. SMAD C.3 with 255 for 1; `skimage.metrics.peak_signal_noise_ratio(data_range=1)`.
    """
    check_images(a, b)
    return _psnr(jnp.asarray(a), jnp.asarray(b))


def masked_psnr(a: Images, b: Images, mask: Float[Array | np.ndarray, "... _ _ 1"]) -> Float[Array, "..."]:
    """`psnr` of the pixels inside a mask (..., h, w, 1) of zeros and ones; raises ValueError as that does."""
    # Zeros outside of the mask differ by nothing: the mean over it is larger by its share of the picture.
    return psnr(a * mask, b * mask) + 10 * jnp.log10(jnp.mean(jnp.asarray(mask), axis=(-3, -2, -1)))


def ssim(a: Images, b: Images) -> Float[Array, "..."]:
    """Structural similarity of images (..., h, w, c) in [0, 1] as its authors define it, 1 for equal images.

    `avatarjax.splat.losses.ssim` over any batch axes; that docstring has the window and scikit-image's options. Raises
    ValueError as `psnr`, and for images smaller than 11x11 pixels. Wang et al. 2004; SMAD C.3.
    """
    check_images(a, b)
    return _ssim(jnp.asarray(a), jnp.asarray(b))


def check_images(*images: Images) -> None:
    """Raise ValueError unless images (..., h, w, c) have one shape and are finite and within [0, 1].

    Values are looked at only outside jit; there they are known.
    """
    shapes = {tuple(x.shape) for x in images}
    if len(shapes) > 1:
        raise ValueError(f"images to compare have different shapes: {', '.join(map(str, sorted(shapes)))}")
    for x in images:
        if isinstance(x, jax.core.Tracer) or not x.size:
            continue
        low, high = (x.min(), x.max()) if isinstance(x, np.ndarray) else np.asarray(_range(x))
        if not 0 <= low <= high <= 1:
            raise ValueError(f"images must be finite and within [0, 1], got values from {low} to {high}")


@jax.jit
def _range(x: Array) -> Float[Array, "2"]:
    return jnp.stack([jnp.min(x), jnp.max(x)])


@jax.jit
def _psnr(a: Array, b: Array) -> Array:
    return -10 * jnp.log10(jnp.mean((a - b) ** 2, axis=(-3, -2, -1)))


@jax.jit
def _ssim(a: Array, b: Array) -> Array:
    # One pair after another: the windows of a long video would not fit into memory at once.
    flat = (x.reshape(-1, *x.shape[-3:]) for x in (a, b))
    return jax.lax.map(lambda pair: losses.ssim(*pair), tuple(flat)).reshape(a.shape[:-3])
