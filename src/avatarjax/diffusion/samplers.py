"""Samplers as `lax.scan`: DDIM for epsilon-predicting networks, with classifier-free guidance."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

Denoiser = Callable[[Float[Array, "*d"], Int[Array, ""]], Float[Array, "*d"]]


def ddim(
    predict_noise: Denoiser,
    start: Float[Array, "*d"],
    alphas_cumprod: Float[Array, "train_steps"],
    timesteps: Int[Array, "steps"],
) -> Float[Array, "*d"]:
    """Deterministic DDIM (Song et al. 2021, Eq. 12 with eta = 0) from pure noise `start` to a clean sample.

    `predict_noise(x, t)` is the network's epsilon at scalar timestep t; `timesteps` descend.
    """
    signal = alphas_cumprod[timesteps]
    next_signal = jnp.concatenate([signal[1:], jnp.ones(1, signal.dtype)])

    def step(x, inputs):
        t, a, a_next = inputs
        noise = predict_noise(x, t)
        clean = (x - jnp.sqrt(1 - a) * noise) / jnp.sqrt(a)
        return jnp.sqrt(a_next) * clean + jnp.sqrt(1 - a_next) * noise, None

    return jax.lax.scan(step, start, (timesteps, signal, next_signal))[0]


def guided(conditional: Denoiser, unconditional: Denoiser, scale: float) -> Denoiser:
    """Classifier-free guidance (Ho and Salimans 2022): u + scale (c - u). Scale 1 costs one network call only."""
    if scale == 1.0:
        return conditional

    def predict(x, t):
        u = unconditional(x, t)
        return u + scale * (conditional(x, t) - u)

    return predict
