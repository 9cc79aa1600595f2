"""The rollout of a UNICA run: the report's script of keys, its video and its pictures."""

from __future__ import annotations

import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from avatarjax import unica
from avatarjax.io import exr, ply, video
from avatarjax.metrics import responsiveness
from experiments import pictures

SCRIPT = (1,) * 60 + (2,) * 60 + (3,) * 60 + (0,) * 20  # UNICA C.4: 60 W, 60 S, 60 A, 20 idle
CHUNK = 20


def roll_and_draw(avatar: unica.Avatar, script: tuple[int, ...], folder: Path, seed: int) -> unica.Frame:
    """Roll a script out from standing and write video, contact sheet and one frame's Gaussians; returns the frames."""
    roll = jax.jit(unica.rollout)
    state = unica.reset(avatar, jax.random.fold_in(jax.random.key(seed), 7))
    parts = []
    for start in tqdm(range(0, len(script), CHUNK), desc="rollout", unit=f"{CHUNK} frames"):
        state, frames = roll(avatar, state, jnp.asarray(script[start : start + CHUNK]))
        parts.append(jax.device_get(frames))
    frames = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    if not all(np.isfinite(x).all() for x in jax.tree.leaves(frames.gaussians)):
        raise FloatingPointError("the rollout has Gaussians that are not finite: train longer, or lower the rates")

    size = avatar.config.data.image_size
    views = list(pictures.draw_frames(jax.tree.map(jnp.asarray, frames.gaussians), frames.root, size))
    video.write_video(folder / "video.mp4", (np.concatenate(list(v), axis=1) for v in views))
    exr.write_png(folder / "contact_sheet.png", pictures.contact_sheet(views, pictures.key_frames(script)))
    cloud = jax.tree.map(lambda x: jnp.asarray(x[len(script) // 2]), frames.gaussians)
    ply.write_ply(folder / "frame.ply", cloud)
    return frames


def before_each_action(avatar: unica.Avatar, roots: np.ndarray) -> np.ndarray:
    """Roots (f, 3) at the frames where each action sets in, as recordings have them, from those after each action."""
    start = unica.reset(avatar, jax.random.key(0)).offset
    return np.concatenate([np.asarray(start)[None], roots[:-1]])


def answers(avatar: unica.Avatar, roots: np.ndarray, script: tuple[int, ...]) -> list[dict[str, typing.Any]]:
    """How root paths (f, 3), as `before_each_action` gives them, answer what the avatar knows its keys to ask for."""
    yaw, moves = (np.asarray(x, np.float64) for x in (avatar.dynamics.action_yaw, avatar.dynamics.action_moves))
    return responsiveness.responses(roots, np.asarray(script), yaw, moves)
