"""Extended position-based dynamics of cloth with small steps (Macklin et al. 2019), one frame or many, as `lax.scan`.

A frame is cut into steps of a few milliseconds with one pass over the constraints each, which converges better than
many passes over a long step. Where the cloth is sewn on and what it collides with move in straight lines between
frames. Everything is a pure function of the state: the same inputs give the same cloth. For several cloths at once use
`jax.lax.map`: under `vmap` XLA's CPU backend gathers and scatters more than ten times slower.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from avatarjax.physics import contacts
from avatarjax.physics.cloth import Cloth
from avatarjax.physics.contacts import Capsules, Columns, Surface, columns


@dataclasses.dataclass(frozen=True)
class XPBDConfig:
    """How a frame is simulated: `substeps` steps; solid surfaces are found anew `refreshes` times (a divisor of
    substeps), the cloth's own neighbours once.

    gravity, wind in metres a second (squared); damping: share of the speed against the world that is lost a second;
    distance: metres that a sheet keeps from itself and from those it is worn over, 0 for no self-collision; top_speed:
    metres a second that nothing exceeds against the body.
    """

    fps: float = 30.0
    substeps: int = 32
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
    touching = None
    if config.distance > 0:
        x = state.positions
        neighbours = contacts.find_neighbours(x, cloth.rest, cloth.pieces, config.distance)
        touching = neighbours, contacts.find_inner(x, cloth.pieces, cloth.covering)

    def refresh(state: ClothState, k: Array) -> tuple[ClothState, None]:
        low = jax.tree.map(lambda a, b: a + (b - a) * (k / config.refreshes), start, end)
        high = jax.tree.map(lambda a, b: a + (b - a) * ((k + 1) / config.refreshes), start, end)
        return _part(cloth, state, low, high, touching, config, part), None

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
    a, b, c = (columns(positions[faces[:, k]]) for k in range(3))
    p, q = contacts.minus(b, a), contacts.minus(c, a)
    flat = p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]
    corners = faces.T.reshape(-1)
    total = tuple(jnp.zeros(positions.shape[0]).at[corners].add(jnp.tile(f, 3)) for f in flat)
    inverse = jax.lax.rsqrt(contacts.dot(total, total) + 1e-18)
    return jnp.stack([t * inverse for t in total], axis=1)


def _part(
    cloth: Cloth,
    state: ClothState,
    start: Drive,
    end: Drive,
    touching: tuple[Array, Array] | None,
    config: XPBDConfig,
    steps: int,
) -> ClothState:
    """`steps` steps with the solid surfaces that are near at their beginning; `touching` are the neighbours and inner
    vertices of the cloth itself."""
    dt = 1 / (config.fps * config.substeps)
    planes = contacts.find_planes(state.positions, start.surface)
    low, high = contacts.take_planes(start.surface, planes), contacts.take_planes(end.surface, planes)
    moved = jax.tree.map(lambda a, b: (b - a) / steps, low[0], high[0])
    normals = columns(vertex_normals(state.positions, cloth.faces))
    rest = columns(cloth.rest)
    loose = cloth.inverse_masses > 0
    free = loose.astype(jnp.float32)
    targets = columns(start.targets), columns(end.targets)
    carried = jax.tree.map(lambda a, b: (b - a) / (steps * dt), *targets)
    slower = (1 - config.damping) ** dt
    solve = _pair_solver(cloth, dt)

    def one(carry: tuple[Columns, Columns], k: Array) -> tuple[tuple[Columns, Columns], None]:
        before, velocity = carry
        share = (k + 1) / steps

        def between(a: typing.Any, b: typing.Any) -> typing.Any:
            return jax.tree.map(lambda a, b: a + (b - a) * share, a, b)

        target = between(*targets)
        velocity = jax.tree.map(lambda v, g, w: v + g * dt - w, velocity, config.gravity, config.wind)
        velocity = _air(velocity, normals, cloth.drag, dt)
        velocity = jax.tree.map(lambda v, w: (v + w) * slower, velocity, config.wind)
        x = _where(loose, contacts.along(before, jnp.asarray(dt), velocity), target)
        x = solve(x)
        x = _tie(x, contacts.take(x, cloth.tether), cloth.tether_length)
        if touching is not None:
            x = contacts.separate(x, touching[0], rest, free, config.distance)
            x = contacts.keep_outside(x, touching[1], normals, config.distance)
        x = _tie(x, target, cloth.reach)
        x = contacts.push_out_of_capsules(x, between(start.capsules, end.capsules))
        points, lean = between(low, high)
        inverse = jax.lax.rsqrt(contacts.dot(lean, lean) + 1e-12)
        lean = jax.tree.map(lambda c: c * inverse, lean)
        x = contacts.push_out(x, before, points, lean, moved, cloth.clearance, cloth.friction)
        x = _where(loose, (x[0], jnp.maximum(x[1], cloth.clearance), x[2]), target)
        against = jax.tree.map(lambda a, b, c: (a - b) / dt - c, x, before, carried)
        speed = jax.lax.rsqrt(contacts.dot(against, against) + 1e-12)
        return (x, contacts.along(carried, jnp.minimum(1.0, config.top_speed * speed), against)), None

    carry = columns(state.positions), columns(state.velocities)
    (x, velocity), _ = jax.lax.scan(one, carry, jnp.arange(steps, dtype=jnp.float32))
    return ClothState(jnp.stack(x, axis=1), jnp.stack(velocity, axis=1))


def _pair_solver(cloth: Cloth, dt: float) -> Callable[[Columns], Columns]:
    """One pass over all distance constraints, colour after colour (Macklin et al. 2016, Eq. 18 with lambda 0)."""
    # Pairs that fill a colour up name a vertex after the last, which has no mass.
    masses = jnp.append(cloth.inverse_masses, 0.0)[cloth.pairs]
    stiffness = 1 / (masses[..., 0] + masses[..., 1] + cloth.compliances / dt**2 + 1e-12)
    inputs = cloth.pairs[..., 0], cloth.pairs[..., 1], cloth.lengths, masses * stiffness[..., None]

    def colour(x: Columns, inputs: tuple[Array, Array, Array, Array]) -> tuple[Columns, None]:
        a, b, length, weight = inputs
        offset = contacts.minus(contacts.take(x, a), contacts.take(x, b))
        lacking = length * jax.lax.rsqrt(contacts.dot(offset, offset) + 1e-18) - 1
        up, down = weight[:, 0] * lacking, weight[:, 1] * lacking

        def moved(c: Array, d: Array) -> Array:
            c = c.at[a].add(up * d, mode="promise_in_bounds")
            return c.at[b].add(-down * d, mode="promise_in_bounds")

        return jax.tree.map(moved, x, offset), None

    def solve(x: Columns) -> Columns:
        padded = jax.tree.map(lambda c: jnp.append(c, 0.0), x)
        return jax.tree.map(lambda c: c[:-1], jax.lax.scan(colour, padded, inputs)[0])

    return solve


def _where(condition: Array, a: Columns, b: Columns) -> Columns:
    return jax.tree.map(lambda p, q: jnp.where(condition, p, q), a, b)


def _tie(x: Columns, anchor: Columns, length: Array) -> Columns:
    """Pull vertices back to at most `length` from their anchors."""
    offset = contacts.minus(x, anchor)
    inverse = jax.lax.rsqrt(contacts.dot(offset, offset) + 1e-18)
    return contacts.along(anchor, jnp.minimum(1.0, length * inverse), offset)


def _air(velocity: Columns, normals: Columns, drag: Array, dt: float) -> Columns:
    """Velocity against the air after `dt` of quadratic drag, implicit and so never reversed; along the sheet a tenth
    of that across it."""
    across = contacts.dot(velocity, normals)
    flat = contacts.along(velocity, -across, normals)
    speed = jnp.sqrt(contacts.dot(flat, flat) + 1e-12)
    drag = drag * dt
    slowed = 1 / (1 + 0.1 * drag * speed)
    across = across / (1 + drag * jnp.abs(across))
    return jax.tree.map(lambda f, n: f * slowed + across * n, flat, normals)
