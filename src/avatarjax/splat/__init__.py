"""Differentiable 3D Gaussian splatting in plain JAX, and the photometric losses."""

from avatarjax.splat.config import SplatConfig
from avatarjax.splat.losses import l1, ssim
from avatarjax.splat.render import RenderInfo, RenderOutput, render, required_capacity

__all__ = ["RenderInfo", "RenderOutput", "SplatConfig", "l1", "render", "required_capacity", "ssim"]
