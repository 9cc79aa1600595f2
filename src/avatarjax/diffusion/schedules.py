"""Noise schedules of discrete-time diffusion: one array of cumulative signal powers."""

from __future__ import annotations

import typing

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

ScheduleName = typing.Literal["linear", "scaled_linear", "cosine"]


def alphas_cumprod(name: ScheduleName, steps: int) -> Float[Array, "steps"]:
    """Cumulative products of 1 - beta for each of `steps` timesteps, falling from about 1 towards 0.

    "linear": DDPM (Ho et al. 2020), "scaled_linear": the betas of Stable Diffusion 1.5 (linear in their square root),
    "cosine": Nichol and Dhariwal 2021. Raises ValueError for another name.
    """
    if name == "linear":
        betas = np.linspace(1e-4, 0.02, steps) * (1000 / steps)
    elif name == "scaled_linear":
        betas = np.linspace(0.00085**0.5, 0.012**0.5, steps) ** 2 * (1000 / steps)
    elif name == "cosine":
        signal = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
        betas = 1 - signal[1:] / signal[:-1]
    else:
        raise ValueError(f"unknown noise schedule {name!r}: choose one of {typing.get_args(ScheduleName)}")
    return jnp.asarray(np.cumprod(1 - np.minimum(betas, 0.999)), jnp.float32)


def add_noise(
    alphas_cumprod: Float[Array, "steps"],
    clean: Float[Array, "b *d"],
    noise: Float[Array, "b *d"],
    timesteps: Int[Array, "b"],
) -> Float[Array, "b *d"]:
    """The forward process q(x_t | x_0) at each sample's timestep (DDPM Eq. 4)."""
    a = alphas_cumprod[timesteps].reshape((-1,) + (1,) * (clean.ndim - 1))
    return jnp.sqrt(a) * clean + jnp.sqrt(1 - a) * noise


def ddim_timesteps(train_steps: int, sample_steps: int) -> Int[Array, "sample_steps"]:
    """Descending timesteps from `train_steps - 1`, evenly spaced ("trailing" spacing, Lin et al. 2024).

    Raises ValueError unless 1 <= sample_steps <= train_steps.
    """
    if not 1 <= sample_steps <= train_steps:
        raise ValueError(f"sampling steps must lie in 1..{train_steps}, got {sample_steps}")
    ends = train_steps - np.arange(sample_steps) * train_steps / sample_steps
    return jnp.asarray(np.round(ends).astype(np.int32) - 1)
