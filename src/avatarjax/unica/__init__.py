"""UNICA: an avatar that answers keys, as a diffusion model over position maps and a point transformer."""

from avatarjax.unica.avatar import Avatar
from avatarjax.unica.config import PRESETS, UnicaConfig, preset
from avatarjax.unica.files import load, save
from avatarjax.unica.rollout import Frame, Info, State, dress, reset, rollout, step

__all__ = [
    "PRESETS",
    "Avatar",
    "Frame",
    "Info",
    "State",
    "UnicaConfig",
    "dress",
    "load",
    "preset",
    "reset",
    "rollout",
    "save",
    "step",
]
