"""Volume rendering along rays: intervals in a box, stratified samples, and emission with absorption.

The quadrature of NeRF (Mildenhall et al. 2020, Max 1995): inside of each interval density and colour are constant, so
that alpha_i = 1 - exp(-density_i length_i), and the light of interval i is weighed by what the nearer ones let through.
"""

from __future__ import annotations

import typing

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from avatarjax.cameras import Camera
from avatarjax.smad.voxels import Grid


@typing.no_type_check
@flax.struct.dataclass
class Rays:
    """n rays: origins (n, 3) metres, unit directions (n, 3), and the stretch near..far (n,) of each, metres, that may
    hold anything; empty, far = near, where the ray misses the box."""

    origins: Float[Array, "n 3"]
    directions: Float[Array, "n 3"]
    near: Float[Array, " n"]
    far: Float[Array, " n"]


@typing.no_type_check
@flax.struct.dataclass
class Light:
    """What n rays bring back: color (n, 3) over black, alpha (n,), and the weight (n, s) of each interval in both."""

    color: Float[Array, "n 3"]
    alpha: Float[Array, " n"]
    weights: Float[Array, "n s"]


def cast(
    world_to_camera: Float[Array, "n 4 4"],
    intrinsics: Float[Array, "n 3 3"],
    pixels: Float[Array, "n 2"],
    grid: Grid,
) -> Rays:
    """The rays through pixel coordinates (u, v) of cameras, one each, as far as they cross the grid's box."""
    u, v = pixels[:, 0], pixels[:, 1]
    y = (v - intrinsics[:, 1, 2]) / intrinsics[:, 1, 1]
    x = (u - intrinsics[:, 0, 2] - intrinsics[:, 0, 1] * y) / intrinsics[:, 0, 0]
    rotation = world_to_camera[:, :3, :3]
    directions = jnp.einsum("nji,nj->ni", rotation, jnp.stack([x, y, jnp.ones_like(x)], -1))
    directions = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
    origins = -jnp.einsum("nji,nj->ni", rotation, world_to_camera[:, :3, 3])
    return Rays(origins, directions, *crossing(origins, directions, grid.low, grid.high))


def pixel_rays(camera: Camera, grid: Grid) -> Rays:
    """The rays through the middles of all pixels of one camera, row by row."""
    v, u = jnp.meshgrid(jnp.arange(camera.height) + 0.5, jnp.arange(camera.width) + 0.5, indexing="ij")
    pixels = jnp.stack([u, v], -1).reshape(-1, 2)
    repeat = lambda x: jnp.broadcast_to(x, (len(pixels), *x.shape))  # noqa: E731
    return cast(repeat(camera.world_to_camera), repeat(camera.intrinsics), pixels, grid)


def crossing(
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    low: Float[Array, " 3"],
    high: Float[Array, " 3"],
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Where rays enter and leave a box, metres from their origins and not behind them; both alike where they miss."""
    # A direction along a face never crosses it: a tiny slope keeps 0 / 0 out.
    slope = jnp.where(jnp.abs(directions) < 1e-9, 1e-9, directions)
    one, other = (low[None] - origins) / slope, (high[None] - origins) / slope
    near = jnp.maximum(jnp.max(jnp.minimum(one, other), -1), 0.0)
    far = jnp.min(jnp.maximum(one, other), -1)
    hit = far > near
    return jnp.where(hit, near, 0.0), jnp.where(hit, far, 0.0)


def stratify(
    rays: Rays, samples: int, key: Key[Array, ""] | None, wanted: Float[Array, "n p"] | None = None
) -> tuple[Float[Array, "n s"], Float[Array, "n s"]]:
    """A sample in each of `samples` intervals that share out near..far, and the lengths of these; metres.

    Samples are random in their intervals, or the middles without a key. Intervals are equally long, or, where `wanted`
    says how many samples each of p equal parts of a ray should get (all positive, of any scale), hold equal shares.
    """
    count = len(rays.near)
    shares = jnp.linspace(0.0, 1.0, samples + 1)
    if wanted is None:
        edges = jnp.broadcast_to(shares, (count, samples + 1))
    else:
        parts = wanted.shape[1]
        total = jnp.concatenate([jnp.zeros((count, 1)), jnp.cumsum(wanted, axis=1)], axis=1)
        grid = jnp.linspace(0.0, 1.0, parts + 1)
        edges = jax.vmap(lambda t: jnp.interp(shares, t / t[-1], grid))(total)
    lengths = jnp.diff(edges, axis=1)
    inside = 0.5 if key is None else jax.random.uniform(key, (count, samples))
    span = (rays.far - rays.near)[:, None]
    return rays.near[:, None] + span * (edges[:, :-1] + inside * lengths), span * lengths


def composite(density: Float[Array, "n s"], colors: Float[Array, "n s 3"], lengths: Float[Array, "n s"]) -> Light:
    """Light of intervals in order from the camera: density per metre, colours, lengths in metres."""
    depth = density * lengths
    # Not the sum less its last term: behind a wall of depth 1e6 that would round away what lies before it.
    before = jnp.concatenate([jnp.zeros_like(depth[:, :1]), jnp.cumsum(depth[:, :-1], axis=1)], axis=1)
    weights = jnp.exp(-before) * -jnp.expm1(-depth)
    return Light(jnp.einsum("ns,nsc->nc", weights, colors), jnp.sum(weights, axis=1), weights)


def points(rays: Rays, distances: Float[Array, "n s"]) -> Float[Array, "n s 3"]:
    """The places at these distances along the rays."""
    return rays.origins[:, None] + distances[..., None] * rays.directions[:, None]
