"""Springs solved in closed form over a time step: stable at any step length, so that a frame is one step."""

from __future__ import annotations

import math

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
