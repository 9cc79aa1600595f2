"""SMAD: a clothed avatar from one video, whose Gaussians move as a learned mass-spring-damper system on a graph."""

from avatarjax.smad.config import PRESETS, SmadConfig, preset

__all__ = ["PRESETS", "SmadConfig", "preset"]
