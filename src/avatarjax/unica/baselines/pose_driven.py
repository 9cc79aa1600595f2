"""A pose-driven Gaussian avatar (in the way of Animatable Gaussians, Li et al. 2024; a row of UNICA Table 2).

A skinned template under the given skeleton is a position map of the pose; a network on that map says what the Gaussians
of this pose look like, cloth included, which the skeleton alone does not know. It is our own texel head with room to
move its Gaussians by decimetres: same size, same pictures, same loss, same steps. What it lacks is memory: cloth that
hangs differently in the same pose is averaged.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from avatarjax import posmap
from avatarjax.data.dataset import Dataset
from avatarjax.metrics import lpips
from avatarjax.nets.functional import Params
from avatarjax.train import Run, read_metrics
from avatarjax.unica.appearance import BaseAttributes
from avatarjax.unica.config import UnicaConfig
from avatarjax.unica.train_appearance import train_texels

RATES = (1.5e-3, 5e-3, 1.5e-2)
# Gaussians may leave the skinned template by so much, metres.
REACH = 0.3


def pose_driven(config: UnicaConfig) -> UnicaConfig:
    """The configuration of the baseline: the run's own, with more room for offsets."""
    return dataclasses.replace(config, texel_head=dataclasses.replace(config.texel_head, offset_bound=REACH))


def train(
    config: UnicaConfig,
    data: Dataset,
    run: Run,
    upscaler: posmap.Upscaler,
    base: BaseAttributes,
    skinned: Float[np.ndarray, "p t 3"],
    perceptual: lpips.Network | None = None,
) -> tuple[Params, BaseAttributes]:
    """Train on the pictured poses, of which `skinned` (p, t, 3) are the template's surfaces, metres from their roots.

    Each of RATES is tried for a quarter of the steps; the one with the lowest loss at the end is trained for all of
    them. Checkpoints go below the run's folder.
    """
    config = pose_driven(config)
    stage = config.texels_stage

    def attempt(folder: Path, steps: int, rate: float) -> tuple[Params, BaseAttributes]:
        changed = dataclasses.replace(stage, steps=steps, learning_rate=rate)
        tried = dataclasses.replace(config, texels_stage=changed)
        place = dataclasses.replace(run, folder=folder)
        return train_texels(tried, data, place, upscaler, base, perceptual, surfaces=skinned)

    def last_loss(rate: float) -> float:
        folder = run.folder / f"rate-{rate:g}"
        attempt(folder, max(1, stage.steps // 4), rate)
        losses = [record["loss"] for record in read_metrics(folder / "texels.jsonl")]
        return float(np.mean(losses[-max(1, len(losses) // 10) :]))

    best = min(RATES, key=last_loss)
    return attempt(run.folder / f"best-{best:g}", stage.steps, best)
