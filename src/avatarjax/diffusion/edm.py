"""EDM: preconditioned denoisers over a continuous noise level (Karras et al. 2022)."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

Network = Callable[[Float[Array, "b d"], Float[Array, "b"]], Float[Array, "b d"]]


def denoise(network: Network, x: Float[Array, "b d"], sigma: Float[Array, "b"]) -> Float[Array, "b d"]:
    """The denoised sample D(x; sigma) for data of unit variance (EDM Table 1).

    `network(c_in x, log(sigma) / 4)` sees inputs of unit variance and predicts a target of unit variance.
    """
    s = sigma[:, None]
    total = jnp.sqrt(s * s + 1)
    return x / total**2 + s / total * network(x / total, jnp.log(sigma) / 4)


def loss_weight(sigma: Float[Array, "b"]) -> Float[Array, "b"]:
    """lambda(sigma) = (sigma^2 + 1) / sigma^2, which makes every noise level's initial loss 1 (EDM Table 1)."""
    return (sigma**2 + 1) / sigma**2


def sample_sigma(key: Key[Array, ""], batch: int, low: float, high: float, at_high: float) -> Float[Array, "batch"]:
    """Training noise levels: log-uniform in [low, high], and exactly `high` with probability `at_high`.

    The spike at `high` teaches the one call that a one-step sampler makes.
    """
    uniform_key, spike_key = jax.random.split(key)
    sigma = jnp.exp(jax.random.uniform(uniform_key, (batch,), minval=np.log(low), maxval=np.log(high)))
    return jnp.where(jax.random.uniform(spike_key, (batch,)) < at_high, high, sigma)


def sigma_steps(steps: int, low: float, high: float, rho: float = 5.0) -> Float[Array, "steps_plus_one"]:
    """Descending noise levels of a sampler with `steps` network calls, and a final 0 (EDM Eq. 5).

    With few steps the last level before 0 is raised, by about a factor 7 a step, so that no call is spent on noise that
    is no longer there.
    """
    if steps < 1:
        raise ValueError(f"a sampler needs at least one step, got {steps}")
    low = max(low, high * 0.15 ** (steps - 1))
    ramp = np.linspace(high ** (1 / rho), low ** (1 / rho), steps) ** rho
    return jnp.asarray(np.append(ramp, 0.0), jnp.float32)


def euler(network: Network, noise: Float[Array, "b d"], sigmas: Float[Array, "steps_plus_one"]) -> Float[Array, "b d"]:
    """Deterministic Euler sampling (EDM Alg. 1 without the correction) from unit `noise` along descending `sigmas`."""

    def step(x, levels):
        sigma, sigma_next = levels
        clean = denoise(network, x, jnp.full(x.shape[0], sigma))
        return clean + (x - clean) * (sigma_next / sigma), None

    # Few steps are written out: inside a loop XLA uses a single core of a CPU.
    return jax.lax.scan(step, noise * sigmas[0], (sigmas[:-1], sigmas[1:]), unroll=len(sigmas) <= 5)[0]
