"""How far trained parts are from held-out data, beside what costs nothing: errors in millimetres, one a group."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from avatarjax.data.dataset import Dataset
from avatarjax.posmap import pca as pcs
from avatarjax.unica import batches, coefficients, latent
from avatarjax.unica import train as training
from avatarjax.unica.avatar import Avatar
from avatarjax.unica.baselines import feed_forward
from avatarjax.unica.baselines.feed_forward import FeedForwardDynamics
from avatarjax.unica.rollout import next_maps

CHUNK = 64


def millimetres(predicted: np.ndarray, truth: np.ndarray, scale: float) -> Float[np.ndarray, "g"]:
    """Mean distance (g,) of texels (g, t, 3) given in normalised units."""
    return 1000 / scale * np.linalg.norm(np.asarray(predicted) - truth, axis=-1).mean(-1)


def _in_chunks(function: Callable, *arrays: np.ndarray) -> np.ndarray:
    """`function` over leading-axis blocks of one size: one compilation, bounded memory."""
    count = len(arrays[0])
    parts = []
    for start in range(0, count, CHUNK):
        rows = np.minimum(np.arange(start, start + CHUNK), count - 1)
        parts.append(np.asarray(function(*(jnp.asarray(a[rows]) for a in arrays)))[: count - start])
    return np.concatenate(parts)


def one_step(avatar: Avatar, data: Dataset, chosen: Int[np.ndarray, "g"], key: jax.Array) -> dict[str, np.ndarray]:
    """Error (g,) in mm of the next frame, from true contexts of chosen held-out groups, and of two trivial guesses.

    The keys are "model", "copy last" and "constant velocity"; "turning" (g,) marks groups in a turn.
    """
    config = avatar.config
    windows = batches.windows(data.held_out, 4, config.turn_window)
    scale = float(data.atlas.scale)
    groups, actions = windows.groups(chosen, scale)
    if isinstance(avatar.dynamics, coefficients.CoefficientDynamics):
        predicted = _coefficient_step(avatar, data, windows.frames(chosen), actions, key)
    else:
        step = jax.jit(lambda avatar, g, a: next_maps(avatar, key, g, a))
        predicted = _in_chunks(functools.partial(step, avatar), groups[:, :3], actions)
    truth = groups[:, 3]
    return {
        "model": millimetres(predicted, truth, scale),
        "copy last": millimetres(groups[:, 2], truth, scale),
        "constant velocity": millimetres(2 * groups[:, 2] - groups[:, 1], truth, scale),
        "turning": windows.turning[chosen],
    }


def _coefficient_step(avatar: Avatar, data: Dataset, frames, actions, key) -> np.ndarray:
    """Normalised texels that the coefficient model predicts for windows of frames."""
    flat, roots = training.coefficient_frames(data, data.held_out)
    poses = np.asarray(pcs.project(avatar.dynamics.basis, jnp.asarray(flat)))
    ground = np.append(roots[frames[:, 2], :2], np.zeros((len(frames), 1), np.float32), axis=1)

    @jax.jit
    def step(avatar, pose, root, action):
        context = coefficients.Context(pose, root)
        pose, root = coefficients.sample(avatar.config.coefficients, avatar.dynamics, key, context, action)
        return jax.vmap(lambda p, r: coefficients.world_texels(avatar.dynamics, p, r))(pose, root)

    context_roots = roots[frames[:, :3]] - ground[:, None]
    world = _in_chunks(functools.partial(step, avatar), poses[frames[:, :3]], context_roots, actions)
    origin = data.held_out.roots[frames[:, 2]]
    origin = np.stack([origin[:, 0] - ground[:, 0], origin[:, 1], origin[:, 2] - ground[:, 1]], -1)
    return float(data.atlas.scale) * (world - origin[:, None]) + 0.5


def reconstruction(avatar: Avatar, data: Dataset, chosen: Int[np.ndarray, "g"]) -> dict[str, np.ndarray]:
    """Error (g,) in mm of the autoencoder on fourth frames of held-out groups, and of the mean training map."""
    config, scale = avatar.config, float(data.atlas.scale)
    groups, _ = batches.windows(data.held_out, 4, config.turn_window).groups(chosen, scale)

    @jax.jit
    def around(avatar, texels):
        if isinstance(avatar.dynamics, FeedForwardDynamics):
            return feed_forward.reconstruct(avatar.atlas, avatar.dynamics, texels)
        latents = latent.encode(config.latent, avatar.atlas, avatar.dynamics, texels)
        return latent.decode(config.latent, avatar.atlas, avatar.dynamics, latents)

    fourth = groups[:, 3]
    mean = np.broadcast_to(np.asarray(avatar.dynamics.map_mean), fourth.shape)
    return {
        "autoencoder": millimetres(_in_chunks(functools.partial(around, avatar), fourth), fourth, scale),
        "mean map": millimetres(mean, fourth, scale),
    }


def components(avatar: Avatar, data: Dataset, chosen: Int[np.ndarray, "g"]) -> dict[int, float]:
    """Mean error in mm of held-out frames against the number of principal components kept (UNICA Fig. B).

    Of the basis that aligns generated maps or, where there is none, of the basis in which they are generated; frames
    are the fourth ones of chosen groups.
    """
    windows = batches.windows(data.held_out, 4, avatar.config.turn_window)
    if avatar.pca is not None:
        pca, scale = avatar.pca, float(data.atlas.scale)
        flat = windows.groups(chosen, scale)[0][:, 3].reshape(len(chosen), -1)
    else:
        pca, scale = avatar.dynamics.basis, 1.0
        flat = training.coefficient_frames(data, data.held_out)[0][windows.frames(chosen)[:, 3]]
    return projection_errors(pca, flat, sorted({1, 2, 4, 8, 16, 32, 64, 120, len(pca.basis)}), scale)


def projection_errors(
    pca: pcs.PCA, flat: Float[np.ndarray, "g d"], counts: Sequence[int], scale: float
) -> dict[int, float]:
    """Mean error in mm of flattened maps, `scale` units a metre, against how many components are kept; counts that the
    basis does not have are left out."""
    centred, basis = flat - np.asarray(pca.mean), np.asarray(pca.basis)
    errors = {}
    for count in counts:
        if count <= len(basis):
            back = (centred @ basis[:count].T @ basis[:count] - centred).reshape(len(centred), -1, 3)
            errors[count] = float(millimetres(back, np.zeros_like(back), scale).mean())
    return errors
