"""SMAD: a clothed avatar from one video, whose Gaussians move as a learned mass-spring-damper system on a graph."""

from avatarjax.smad.avatar import Avatar, Frame, reset, rollout, step
from avatarjax.smad.config import PRESETS, SmadConfig, preset
from avatarjax.smad.driving import Pose
from avatarjax.smad.files import load, save

__all__ = [
    "PRESETS",
    "Avatar",
    "Frame",
    "Pose",
    "SmadConfig",
    "load",
    "preset",
    "reset",
    "rollout",
    "save",
    "step",
]
