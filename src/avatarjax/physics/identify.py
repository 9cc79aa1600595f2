"""Which constants a mass-spring-damper system must have to move as it was seen to (SMAD 3.2: learned stiffness k_ij).

Least squares over a trajectory, through the scan that simulates it, by Levenberg-Marquardt. Constants are searched as
logarithms of their ratio to those that the search starts from, so they stay positive; a constant that the motion says
nothing of stays where it started.

The fit is a local one. Over many periods of an oscillation wrong constants lose whole periods against the true ones,
and the search ends between them. Pieces of a few steps have no such minima: each starts from what was observed, whose
differences are by Eq. 4 exactly its velocities. They are more sensitive to noise, so search with a short `window` first
and from there over the whole.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from avatarjax.physics import mass_spring_damper as msd
from avatarjax.physics.mass_spring_damper import Springs


@dataclasses.dataclass(frozen=True)
class IdentifyConfig:
    """What is fitted: one stiffness for each edge or one factor for all, the same for the damping of nodes, and the
    masses at a given total.

    window: steps of the pieces into which the trajectory is cut, None for one piece; the rest of the last is left out.
    The search ends where a step changes logarithms, and errors relative to the motion, by less than `tolerance`, or
    after `max_steps`.
    """

    stiffness: typing.Literal["edges", "shared", "fixed"] = "edges"
    damping: typing.Literal["nodes", "shared", "fixed"] = "shared"
    mass: typing.Literal["nodes", "fixed"] = "fixed"
    window: int | None = None
    tolerance: float = 1e-4
    max_steps: int = 64

    def __post_init__(self):
        if self.stiffness == self.damping == self.mass == "fixed":
            raise ValueError("stiffness, damping and mass are all fixed: nothing is left to fit")
        if self.window is not None and self.window < 1:
            raise ValueError(f"a window of {self.window} steps must have at least one")
        if self.tolerance <= 0 or self.max_steps < 1:
            raise ValueError(f"tolerance {self.tolerance} and max_steps {self.max_steps} must be positive")


@typing.no_type_check
@flax.struct.dataclass
class Fit:
    """The fitted springs, the root mean square error () of a coordinate, metres, that they leave over the pieces that
    were fitted, whether the search converged () and after how many steps ()."""

    springs: Springs
    residual: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]


def identify(
    start: Springs,
    observed: Float[Array, "s n 3"],
    position: Float[Array, "n 3"],
    velocity: Float[Array, "n 3"],
    external: Float[Array, "t n 3"] | None,
    dt: float,
    rotations: Float[Array, "t 3 3"] | None = None,
    config: IdentifyConfig = IdentifyConfig(),
) -> Fit:
    """Springs whose motion from (position, velocity) is nearest to the observed positions after each of t steps.

    `start` gives the graph, its rest state, what is not fitted, and where the search begins. What is to be fitted must
    be positive there: zero has no logarithm, and stays zero. Without external forces only ratios of stiffness and
    damping to mass can be seen. The Jacobian is dense: t n 3 numbers for each constant. Raises ValueError where
    `observed` has another number of steps than what drives the system.
    """
    steps = len(external) if external is not None else len(rotations) if rotations is not None else 0
    if len(observed) != steps:
        raise ValueError(f"{len(observed)} observed steps, but {steps} of external forces or rotations")
    window = min(config.window or steps, steps)
    pieces = steps // window
    known = jnp.concatenate([position[None], observed])
    starts = known[: pieces * window : window]
    speeds = jnp.concatenate([velocity[None], (known[1:] - known[:-1])[window - 1 :: window][: pieces - 1] / dt])
    cut = jax.tree.map(
        lambda x: x[: pieces * window].reshape(pieces, window, *x.shape[1:]), (observed, external, rotations)
    )
    spread = jnp.sqrt(jnp.mean((observed - position[None]) ** 2)) + jnp.finfo(observed.dtype).tiny

    def error(logs, _):
        springs = _scaled(start, logs)

        def piece(position, velocity, seen, external, rotations):
            return msd.simulate(springs, position, velocity, external, dt, rotations)[0] - seen

        return jax.vmap(piece)(starts, speeds, *cut) / spread

    # Zeros of each constant's own shape: one number where all share a factor.
    shapes = {"edges": start.stiffness.shape, "nodes": start.mass.shape, "shared": ()}
    names = ("stiffness", "damping", "mass")
    logs = {k: jnp.zeros(shapes[getattr(config, k)]) for k in names if getattr(config, k) != "fixed"}
    solver = optx.LevenbergMarquardt(rtol=config.tolerance, atol=config.tolerance)
    solution = optx.least_squares(error, solver, logs, max_steps=config.max_steps, throw=False)
    residual = spread * jnp.sqrt(jnp.mean(error(solution.value, None) ** 2))
    return Fit(
        springs=_scaled(start, solution.value),
        residual=residual,
        converged=(solution.result == optx.RESULTS.successful) & jnp.isfinite(residual),
        steps=solution.stats["num_steps"],
    )


def _scaled(springs: Springs, logs: dict[str, Array]) -> Springs:
    """Springs with each constant multiplied by the exponential of its logarithm, the total mass kept."""
    changed = {name: getattr(springs, name) * jnp.exp(log) for name, log in logs.items()}
    if "mass" in changed:
        changed["mass"] = changed["mass"] * (jnp.sum(springs.mass) / jnp.sum(changed["mass"]))
    return springs.replace(**changed)
