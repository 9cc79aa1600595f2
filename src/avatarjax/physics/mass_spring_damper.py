"""Point masses on linear springs with damping (SMAD Eqs. 2-4), as an explicit scan.

A spring's rest state is an offset, a vector, and not a length: k (x_i - x_j - L_ij) also resists turning. Where the
whole system turns with a root, the offsets have to turn with it, which `rotation` does.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

_POWER_ITERATIONS = 300


@typing.no_type_check
@flax.struct.dataclass
class Springs:
    """e undirected springs among n masses, each listed once: an edge (i, j) pulls i and, the other way, j.

    edges (e, 2); mask (e,), False for padding; rest (e, 3) the offset x_i - x_j at rest, metres, in the root's frame;
    stiffness (e,) newtons a metre; mass (n,) kilograms; damping (n,) newton seconds a metre, against the world.
    """

    edges: Int[Array, "e 2"]
    mask: Bool[Array, "e"]
    rest: Float[Array, "e 3"]
    stiffness: Float[Array, "e"]
    mass: Float[Array, "n"]
    damping: Float[Array, "n"]


def connect(
    positions: Float[np.ndarray, "n 3"],
    edges: Int[np.ndarray, "e 2"],
    stiffness: Float[np.ndarray, " e"] | float,
    mass: Float[np.ndarray, " n"] | float = 1.0,
    damping: Float[np.ndarray, " n"] | float = 0.0,
) -> Springs:
    """Springs that are at rest where the nodes are; one number stands for all springs or all nodes.

    Raises ValueError for edges that join no two nodes, masses that are not positive, and constants that are negative or
    not finite.
    """
    count = len(positions)
    if not np.isfinite(positions).all():
        raise ValueError("positions at rest must be finite")
    wrong = (edges < 0).any(axis=1) | (edges >= count).any(axis=1) | (edges[:, 0] == edges[:, 1])
    if wrong.any():
        raise ValueError(f"edge {edges[wrong][0].tolist()} does not join two of {count} nodes: drop it")
    for name, value in {"stiffness": stiffness, "mass": mass, "damping": damping}.items():
        low = np.min(value, initial=np.inf)
        if not np.isfinite(value).all() or low < 0 or (name == "mass" and low == 0):
            raise ValueError(f"{name} as low as {low} or not finite: it must be {'>' if name == 'mass' else '>='} 0")
    rest = positions[edges[:, 0]] - positions[edges[:, 1]]

    def filled(value, length):
        return jnp.asarray(np.broadcast_to(value, length), jnp.float32)

    return Springs(
        edges=jnp.asarray(edges, jnp.int32),
        mask=jnp.ones(len(edges), bool),
        rest=jnp.asarray(rest, jnp.float32),
        stiffness=filled(stiffness, len(edges)),
        mass=filled(mass, count),
        damping=filled(damping, count),
    )


def acceleration(
    springs: Springs,
    position: Float[Array, "n 3"],
    velocity: Float[Array, "n 3"],
    external: Float[Array, "n 3"] | None = None,
    rotation: Float[Array, "3 3"] | None = None,
) -> Float[Array, "n 3"]:
    """Metres a second squared (SMAD Eq. 3), under external forces (n, 3) in newtons.

    `rotation` takes offsets at rest from the root's frame to that of the positions.
    """
    pull = _stiffness(springs)[:, None] * _stretch(springs, position, rotation)
    i, j = springs.edges.T
    force = (-springs.damping[:, None] * velocity).at[i].add(-pull).at[j].add(pull)
    return (force if external is None else force + external) / springs.mass[:, None]


def euler_step(
    position: Float[Array, "*s"],
    velocity: Float[Array, "*s"],
    acceleration: Float[Array, "*s"],
    dt: Float[Array, ""] | float,
) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """Position and velocity `dt` seconds later (SMAD Eq. 4): the velocity first, and by the new one the position.

    The paper calls it explicit Euler; in this order it is the semi-implicit one, which keeps the energy of an undamped
    system bounded.
    """
    velocity = velocity + dt * acceleration
    return position + dt * velocity, velocity


def simulate(
    springs: Springs,
    position: Float[Array, "n 3"],
    velocity: Float[Array, "n 3"],
    external: Float[Array, "t n 3"] | None,
    dt: Float[Array, ""] | float,
    rotations: Float[Array, "t 3 3"] | None = None,
) -> tuple[Float[Array, "t n 3"], Float[Array, "t n 3"]]:
    """Positions and velocities after each of t steps, under external forces, turning roots, or both.

    Step k takes external[k] and rotations[k]. Raises ValueError where neither says how many steps there are.
    """
    if external is None and rotations is None:
        raise ValueError("external forces or rotations must be given: their length is the number of steps")

    def step(state, driven):
        force, rotation = driven
        state = euler_step(*state, acceleration(springs, *state, force, rotation), dt)
        return state, state

    return jax.lax.scan(step, (position, velocity), (external, rotations))[1]


def energy(
    springs: Springs,
    position: Float[Array, "n 3"],
    velocity: Float[Array, "n 3"],
    rotation: Float[Array, "3 3"] | None = None,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Kinetic and elastic energy, joules."""
    stretch = _stretch(springs, position, rotation)
    kinetic = 0.5 * jnp.sum(springs.mass[:, None] * velocity**2)
    return kinetic, 0.5 * jnp.sum(_stiffness(springs)[:, None] * stretch**2)


def stability_limit(springs: Springs) -> Float[Array, ""]:
    """The longest time step, seconds, at which Eq. 4 is sure to keep the system's motion bounded.

    A mode of angular frequency w and damping rate c = damping / mass stays bounded while w^2 dt^2 + 2 c dt < 4; w is
    the highest frequency and c the highest rate, so the limit is exact without damping and where all rates are equal.
    The frequency comes by power iteration, which approaches it from below: keep a margin of a few per cent. Infinite
    for masses without springs and damping.
    """
    i, j = springs.edges.T
    scale = jax.lax.rsqrt(springs.mass)
    stiffness = _stiffness(springs)

    def multiply(mode):
        pull = stiffness * ((scale * mode)[i] - (scale * mode)[j])
        return scale * jnp.zeros_like(mode).at[i].add(pull).at[j].add(-pull)

    def iterate(_, mode):
        mode = multiply(mode)
        return mode * jax.lax.rsqrt(jnp.vdot(mode, mode) + jnp.finfo(mode.dtype).tiny)

    start = jax.random.normal(jax.random.key(0), scale.shape, scale.dtype)
    mode = jax.lax.fori_loop(0, _POWER_ITERATIONS, iterate, start)
    square = jnp.maximum(jnp.vdot(mode, multiply(mode)), 0.0)
    rate = jnp.max(springs.damping / springs.mass)
    return 4 / (rate + jnp.sqrt(rate**2 + 4 * square))


def _stiffness(springs: Springs) -> Float[Array, "e"]:
    return jnp.where(springs.mask, springs.stiffness, 0.0)


def _stretch(springs: Springs, position, rotation) -> Float[Array, "e 3"]:
    rest = springs.rest if rotation is None else springs.rest @ rotation.T
    i, j = springs.edges.T
    return position[i] - position[j] - rest
