"""Extended position-based dynamics of cloth with small steps (Macklin et al. 2019), one frame or many, as `lax.scan`.

A frame is cut into steps of a few milliseconds with one pass over the constraints each, which converges better than
many passes over a long step. Where the cloth is sewn on and what it collides with move in straight lines between
frames. Everything is a pure function of the state: the same inputs give the same cloth.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax.physics import contacts
from avatarjax.physics.cloth import Cloth
from avatarjax.physics.contacts import Capsules, Surface


@dataclasses.dataclass(frozen=True)
class XPBDConfig:
    """How a frame is simulated: `substeps` steps; solid surfaces are found anew `refreshes` times (a divisor of
    substeps), the cloth's own neighbours once.

    gravity, wind in metres a second (squared); damping: share of the speed lost a second; distance: metres that a sheet
    keeps from itself and from those it is worn over, 0 for no self-collision; top_speed: metres a second that nothing
    exceeds against the body.
    """

    fps: float = 30.0
    substeps: int = 20
    refreshes: int = 2
    gravity: tuple[float, float, float] = (0.0, -9.81, 0.0)
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    damping: float = 0.5
    distance: float = 0.01
    top_speed: float = 12.0

    def __post_init__(self):
        if self.substeps < 1 or self.refreshes < 1 or self.substeps % self.refreshes:
            raise ValueError(f"{self.substeps} steps a frame cannot be cut into {self.refreshes} equal parts")


@typing.no_type_check
@flax.struct.dataclass
class ClothState:
    """Positions (n, 3) in metres and velocities (n, 3) in metres a second."""

    positions: Float[Array, "n 3"]
    velocities: Float[Array, "n 3"]


@typing.no_type_check
@flax.struct.dataclass
class Drive:
    """What the cloth hangs on in one frame: targets (n, 3), where the skeleton carries each vertex, the solid surface,
    and the capsules that bridge it."""

    targets: Float[Array, "n 3"]
    surface: Surface
    capsules: Capsules


def step(cloth: Cloth, state: ClothState, start: Drive, end: Drive, config: XPBDConfig = XPBDConfig()) -> ClothState:
    """The cloth one frame later, while what it hangs on goes from `start` to `end`."""
    part = config.substeps // config.refreshes
    neighbours = None
    if config.distance > 0:
        neighbours = contacts.find_neighbours(state.positions, cloth.rest, cloth.pieces, config.distance)

    def refresh(state: ClothState, k: Array) -> tuple[ClothState, None]:
        low = jax.tree.map(lambda a, b: a + (b - a) * (k / config.refreshes), start, end)
        high = jax.tree.map(lambda a, b: a + (b - a) * ((k + 1) / config.refreshes), start, end)
        return _part(cloth, state, low, high, neighbours, config, part), None

    return jax.lax.scan(refresh, state, jnp.arange(config.refreshes, dtype=jnp.float32))[0]


def simulate(
    cloth: Cloth, state: ClothState, drives: Drive, config: XPBDConfig = XPBDConfig()
) -> tuple[ClothState, Float[Array, "f n 3"]]:
    """The cloth's positions (f, n, 3) at drives 1 to f, from its state at drive 0; drives have a leading axis f + 1."""

    def one(carry: tuple[ClothState, Drive], end: Drive) -> tuple[tuple[ClothState, Drive], Array]:
        state, start = carry
        state = step(cloth, state, start, end, config)
        return (state, end), state.positions

    first = jax.tree.map(lambda x: x[0], drives)
    rest = jax.tree.map(lambda x: x[1:], drives)
    (state, _), positions = jax.lax.scan(one, (state, first), rest)
    return state, positions


def vertex_normals(positions: Float[Array, "n 3"], faces: Array) -> Float[Array, "n 3"]:
    """Unit normals (n, 3) of a mesh, weighted by area."""
    a, b, c = (positions[faces[:, k]] for k in range(3))
    flat = jnp.cross(b - a, c - a)
    total = jnp.zeros_like(positions)
    for k in range(3):
        total = total.at[faces[:, k]].add(flat)
    return total / jnp.sqrt(jnp.sum(total * total, axis=1, keepdims=True) + 1e-18)


def _part(
    cloth: Cloth,
    state: ClothState,
    start: Drive,
    end: Drive,
    neighbours: Array | None,
    config: XPBDConfig,
    steps: int,
) -> ClothState:
    """`steps` steps with the contacts that are near at their beginning."""
    dt = 1 / (config.fps * config.substeps)
    planes = contacts.find_planes(state.positions, start.surface)
    low, high = contacts.take_planes(start.surface, planes), contacts.take_planes(end.surface, planes)
    moved = (high.points - low.points) / steps
    normals = vertex_normals(state.positions, cloth.faces)
    free = (cloth.inverse_masses > 0).astype(jnp.float32)
    loose = free[:, None] > 0
    carried = (end.targets - start.targets) / (steps * dt)
    slower = (1 - config.damping) ** dt
    inner = contacts.find_inner(state.positions, cloth.pieces) if config.distance > 0 else None

    def one(state: ClothState, k: Array) -> tuple[ClothState, None]:
        share = (k + 1) / steps

        def between(a: Array, b: Array) -> Array:
            return a + (b - a) * share

        target = between(start.targets, end.targets)
        velocity = state.velocities + jnp.asarray(config.gravity)[None] * dt
        velocity = _air(velocity - jnp.asarray(config.wind)[None], normals, cloth.drag, dt)
        velocity = (velocity + jnp.asarray(config.wind)[None]) * slower
        before = state.positions
        x = jnp.where(loose, before + velocity * dt, target)
        x = _solve_pairs(cloth, x, dt)
        x = _tie(x, x[cloth.tether], cloth.tether_length)
        if neighbours is not None:
            x = contacts.separate(x, neighbours, cloth.rest, free, config.distance)
            x = contacts.keep_outside(x, inner, normals, cloth.over, config.distance)
        x = _tie(x, target, cloth.reach)
        columns = contacts.push_out_of_capsules(x.T, jax.tree.map(between, start.capsules, end.capsules))
        points, lean = between(low.points, high.points), between(low.normals, high.normals)
        lean = lean * jax.lax.rsqrt(jnp.sum(lean * lean, axis=1, keepdims=True) + 1e-12)
        columns = contacts.push_out(columns, before.T, Surface(points, lean), moved, cloth.clearance, cloth.friction)
        x = columns.T.at[:, 1].max(cloth.clearance)
        x = jnp.where(loose, x, target)
        velocity = (x - before) / dt
        against = velocity - carried
        speed = jnp.sqrt(jnp.sum(against * against, axis=1, keepdims=True) + 1e-12)
        velocity = carried + against * jnp.minimum(1.0, config.top_speed / speed)
        return ClothState(x, velocity), None

    return jax.lax.scan(one, state, jnp.arange(steps, dtype=jnp.float32))[0]


def _solve_pairs(cloth: Cloth, x: Array, dt: float) -> Array:
    """One pass over all distance constraints, colour after colour (Macklin et al. 2016, Eq. 18 with lambda 0)."""

    def colour(x: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, None]:
        pair, length, compliance = inputs
        a, b = pair[:, 0], pair[:, 1]
        offset = x.at[a].get(mode="clip") - x.at[b].get(mode="clip")
        apart = jnp.sqrt(jnp.sum(offset * offset, axis=1) + 1e-18)
        wa = cloth.inverse_masses.at[a].get(mode="clip")
        wb = cloth.inverse_masses.at[b].get(mode="clip")
        multiplier = (length - apart) / ((wa + wb + compliance / dt**2 + 1e-12) * apart)
        shift = multiplier[:, None] * offset
        x = x.at[a].add(wa[:, None] * shift, mode="drop").at[b].add(-wb[:, None] * shift, mode="drop")
        return x, None

    return jax.lax.scan(colour, x, (cloth.pairs, cloth.lengths, cloth.compliances))[0]


def _tie(x: Array, anchor: Array, length: Array) -> Array:
    """Pull vertices back to at most `length` from their anchors."""
    offset = x - anchor
    apart = jnp.sqrt(jnp.sum(offset * offset, axis=1) + 1e-18)
    return anchor + offset * jnp.minimum(1.0, length / apart)[:, None]


def _air(velocity: Array, normals: Array, drag: Array, dt: float) -> Array:
    """Velocity against the air after `dt` of quadratic drag, implicit and so never reversed; along the sheet a tenth
    of that across it."""
    across = jnp.sum(velocity * normals, axis=1, keepdims=True)
    along = velocity - across * normals
    speed = jnp.sqrt(jnp.sum(along * along, axis=1, keepdims=True) + 1e-12)
    drag = drag[:, None] * dt
    return across / (1 + drag * jnp.abs(across)) * normals + along / (1 + 0.1 * drag * speed)
