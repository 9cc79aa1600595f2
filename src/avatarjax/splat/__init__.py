"""Differentiable 3D Gaussian splatting in plain JAX, and the photometric losses."""

from avatarjax.splat.config import SplatConfig
from avatarjax.splat.losses import l1, ssim
from avatarjax.splat.render import RenderInfo, RenderOutput, check, render, required_capacity
from avatarjax.splat.sh import harmonics, view_colors

__all__ = [
    "RenderInfo",
    "RenderOutput",
    "SplatConfig",
    "check",
    "harmonics",
    "l1",
    "render",
    "required_capacity",
    "ssim",
    "view_colors",
]
