"""How far renders are from pictures: the loss of both appearance stages (UNICA B.1, Eq. 1)."""

from __future__ import annotations

import typing

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.metrics import lpips
from avatarjax.splat import SplatConfig, render, required_capacity
from avatarjax.splat.losses import l1, ssim
from avatarjax.unica.config import UnicaConfig


def loss(
    config: UnicaConfig,
    gaussians: Gaussians,
    views: Camera,
    rgba: UInt8[Array | np.ndarray, "k h w 4"],
    white: Float[Array, ""],
    splat: SplatConfig,
    perceptual: lpips.Network | None = None,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """L1, SSIM and, given the network, LPIPS of renders (k views) against straight-alpha pictures; and PSNR in dB.

    Both are seen over black or white: `white` () is 0 or 1. Alternating backgrounds keep black Gaussians from hiding
    in front of a black one (UNICA C.2).
    """

    def drawn(camera):
        out = render(gaussians, camera, background=white, config=splat)
        return out.image, out.info.dropped

    images, dropped = jax.lax.map(drawn, views)
    truth = over(rgba, white)
    squared = jnp.mean((jnp.clip(images, 0, 1) - truth) ** 2, axis=(1, 2, 3))
    absolute, similarity = l1(images, truth), jax.lax.map(lambda pair: ssim(*pair), (images, truth))
    value = config.loss_l1 * absolute + config.loss_ssim * (1 - jnp.mean(similarity))
    metrics = {
        "psnr": -10 * jnp.mean(jnp.log10(jnp.maximum(squared, 1e-10))),
        "dropped": jnp.sum(dropped).astype(jnp.float32),
    }
    if perceptual is not None:
        # Views come in random order: the first few are a fair sample.
        few = slice(config.lpips_views)
        metrics["lpips"] = jnp.mean(lpips.distance(perceptual, images[few], truth[few]))
        value = value + config.loss_lpips * metrics["lpips"]
    return value, metrics


def settings(config: UnicaConfig, perceptual: lpips.Network | None) -> tuple[typing.Any, ...]:
    """All that the loss depends on beside its inputs, by which checkpoints know what they were trained with."""
    weights = (config.loss_l1, config.loss_ssim)
    if perceptual is None:
        return weights
    return (*weights, config.loss_lpips, config.lpips_views, perceptual.name)


def over(rgba: UInt8[Array | np.ndarray, "*b h w 4"], white: Float[Array, ""] | float) -> Float[Array, "*b h w 3"]:
    """Straight-alpha pictures over black (0), white (1) or a grey between."""
    picture = jnp.asarray(rgba).astype(jnp.float32) / 255
    return picture[..., :3] * picture[..., 3:] + white * (1 - picture[..., 3:])


def pick_views(cameras: Camera, views: np.ndarray) -> Camera:
    """The cameras of these ids from a batch of cameras."""
    return jax.tree.map(lambda x: x[views], cameras)


def splat_config(gaussians: Gaussians, cameras: Camera) -> SplatConfig:
    """Room for three times what the cloud needs before training: its Gaussians will grow."""
    return SplatConfig(capacity=min(2**24, 3 * required_capacity(gaussians, cameras)), depth=False)
