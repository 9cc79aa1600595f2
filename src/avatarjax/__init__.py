"""avatarjax: controllable, dynamic 3D human avatars as pure JAX functions over pytrees."""

from avatarjax import smad, unica
from avatarjax.cameras import Camera, look_at, orbit
from avatarjax.gaussians import Gaussians
from avatarjax.splat import render
from avatarjax.unica import load

__all__ = ["Camera", "Gaussians", "load", "look_at", "orbit", "render", "smad", "unica"]
