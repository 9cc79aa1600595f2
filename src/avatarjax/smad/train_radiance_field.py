"""Training of the deformable radiance field on a monocular video (SMAD 3, "Baselines"; first stage of B.3)."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key
from scipy import ndimage

from avatarjax.data.recording import MonocularVideo
from avatarjax.nets.functional import Params
from avatarjax.smad import radiance_field, views
from avatarjax.smad import volume_rendering as volume
from avatarjax.smad.hull import Hull
from avatarjax.smad.radiance_field import FieldConfig
from avatarjax.train import fit, make_step, new_state, weights
from avatarjax.train.state import Metrics, optimiser

# Three of four rays go through the figure or pass it by no more pixels than this; the others go anywhere.
_NEAR = 6
_NEAR_SHARE = 0.75


@typing.no_type_check
@flax.struct.dataclass
class RayBatch:
    """n pixels of a video: their cameras in the body frame (n, 4, 4) and (n, 3, 3), places (n, 2), times (n,) in 0..1,
    colours (n, 3) in 0..1 and whether (n,) they show the figure; `where` travels along."""

    where: Hull
    world_to_camera: Float[Array, "n 4 4"]
    intrinsics: Float[Array, "n 3 3"]
    pixels: Float[Array, "n 2"]
    times: Float[Array, " n"]
    colors: Float[Array, "n 3"]
    mask: Bool[Array, " n"]


@dataclasses.dataclass(frozen=True, eq=False)
class Trained:
    """A trained field: parameters, its box, and the times (f,) of the frames, for `radiance_field.extract`."""

    params: Params
    where: Hull
    times: Float[np.ndarray, " f"]


def train(video: MonocularVideo, config: FieldConfig, folder: str | os.PathLike, *, seed: int = 0) -> Trained:
    """Fit a field to a video; checkpoints and metrics go to `folder`, from which an interrupted run goes on.

    Raises ValueError as `hull.carve` does.
    """
    frames = np.arange(len(video))
    cameras = views.of_video(video, frames)
    where = radiance_field.space(video.masks, cameras, config)
    images, times = video.images(), frames / max(1, len(frames) - 1)
    matrices = np.asarray(cameras.world_to_camera), np.asarray(cameras.intrinsics)
    size = video.masks.shape[1:]
    near = np.flatnonzero([ndimage.binary_dilation(mask, iterations=_NEAR) for mask in video.masks])

    def batch_at(step: int) -> RayBatch:
        rng = np.random.default_rng((seed, step))
        close = rng.random(config.rays) < _NEAR_SHARE
        chosen = np.where(close, rng.choice(near, config.rays), rng.integers(video.masks.size, size=config.rays))
        frame, row, column = np.unravel_index(chosen, (len(frames), *size))
        return RayBatch(
            where,
            matrices[0][frame],
            matrices[1][frame],
            np.stack([column, row], -1).astype(np.float32) + 0.5,
            times[frame].astype(np.float32),
            images[frame, row, column].astype(np.float32) / 255,
            video.masks[frame, row, column],
        )

    root = jax.random.key(seed)
    state = new_state(
        radiance_field.init(config, where, jax.random.fold_in(root, 0)),
        optimiser(config.learning_rate, config.steps),
        jax.random.fold_in(root, 1),
    )
    step = make_step(lambda *a: loss(config, *a), optimiser(config.learning_rate, config.steps))
    mark = hashlib.sha256(f"{config} {seed} {where.grid}".encode())
    mark.update(np.ascontiguousarray(images))
    state = fit(step, state, batch_at, config.steps, folder, "radiance_field", fingerprint=mark.hexdigest()[:12])
    return Trained(weights(state), where, times.astype(np.float32))


def loss(config: FieldConfig, params: Params, key: Key[Array, ""], batch: RayBatch) -> tuple[Float[Array, ""], Metrics]:
    """Mean squared error of colours before a random background, and of silhouettes.

    A background that changes from step to step tells the field apart from the wall: what the mask leaves out is
    replaced by it, and only what is transparent shows it.
    """
    sample_key, background_key = jax.random.split(key)
    rays = volume.cast(batch.world_to_camera, batch.intrinsics, batch.pixels, batch.where.grid)
    light = radiance_field.render(config, params, batch.where, rays, batch.times, sample_key)
    background = jax.random.uniform(background_key, (1, 3))
    shown = light.color + (1 - light.alpha)[:, None] * background
    photometric = jnp.mean((shown - jnp.where(batch.mask[:, None], batch.colors, background)) ** 2)
    silhouette = jnp.mean((light.alpha - batch.mask) ** 2)
    value = photometric + config.silhouette * silhouette
    return value, {"photometric": photometric, "silhouette": silhouette}
