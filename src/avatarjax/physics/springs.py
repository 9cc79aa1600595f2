"""Springs solved in closed form over a time step: stable at any step length, so that a frame is one step."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def critical_step(
    position: Float[Array, "*s"],
    velocity: Float[Array, "*s"],
    target: Float[Array, "*s"] | float,
    frequency: float,
    dt: float,
) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """Position and velocity after `dt` seconds of a critically damped spring towards a fixed target.

    `frequency` is the undamped angular frequency in radians a second. x'' = -w^2 (x - target) - 2 w x' has the solution
    x - target = (d + (v + w d) t) exp(-w t).
    """
    offset = position - target
    decay = math.exp(-frequency * dt)
    slope = velocity + frequency * offset
    return target + (offset + slope * dt) * decay, (velocity - frequency * slope * dt) * decay


def follow(targets: Float[Array, "f *s"], *, frequency: float, damping: float, dt: float) -> Float[Array, "f *s"]:
    """What an under-damped spring makes of a moving target: (f, ...) samples `dt` seconds apart, starting at rest on
    it.

    The target moves in a straight line between samples and the response to that is exact, overshoot included.
    `frequency` is the undamped angular frequency in radians a second, 0 <= `damping` < 1 its damping ratio; raises
    ValueError outside that range.
    """
    if not (0 <= damping < 1 and frequency > 0):
        raise ValueError(f"need frequency > 0 and 0 <= damping < 1, got {frequency} and {damping}")
    ringing = frequency * math.sqrt(1 - damping**2)
    decay = math.exp(-damping * frequency * dt)
    cosine, sine = math.cos(ringing * dt), math.sin(ringing * dt) / ringing
    trail = 2 * damping / frequency

    def step(state, ends):
        x, v = state
        start, end = ends
        rate = (end - start) / dt
        # Behind a target of constant velocity the spring settles at a distance of `trail` seconds.
        u, du = x - start + trail * rate, v - rate
        x = end - trail * rate + decay * (u * cosine + (du + damping * frequency * u) * sine)
        v = rate + decay * (du * cosine - (damping * frequency * du + frequency**2 * u) * sine)
        return (x, v), x

    first = targets[0]
    _, rest = jax.lax.scan(step, (first, jnp.zeros_like(first)), (targets[:-1], targets[1:]))
    return jnp.concatenate([first[None], rest])
