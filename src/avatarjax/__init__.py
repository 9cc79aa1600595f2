"""avatarjax: controllable, dynamic 3D human avatars as pure JAX functions over pytrees."""

from avatarjax.cameras import Camera, look_at, orbit
from avatarjax.gaussians import Gaussians
from avatarjax.splat import render

__all__ = ["Camera", "Gaussians", "look_at", "orbit", "render"]
