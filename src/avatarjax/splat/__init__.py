"""Differentiable 3D Gaussian splatting in plain JAX, and the photometric losses."""

from avatarjax.splat.config import SplatConfig
from avatarjax.splat.render import RenderInfo, RenderOutput, render, required_capacity

__all__ = ["RenderInfo", "RenderOutput", "SplatConfig", "render", "required_capacity"]
