"""A deformable radiance field, and the canonical Gaussians that come of it (SMAD 3, "Baselines": the 4D NeRF).

A point of the body frame at time t is moved by a network to the canonical space, where a grid holds density and colour.
The paper trains a NeRF for 12.5 hours (Table I) and does not say which; a grid whose values are interpolated before the
activation (Sun et al. 2022, "Direct voxel grid optimization") takes minutes, and colour needs no direction, because the
Gaussians that come of it have none. The average over time of what the camera could see then decides where Gaussians go.
The paper's table of symbols names two more losses, L_smooth and L_bend, and defines neither: they are not here.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Array, Bool, Float, Key
from scipy import ndimage

from avatarjax.cameras import Camera
from avatarjax.gaussians import Gaussians
from avatarjax.nets import functional
from avatarjax.nets.blocks import octaves
from avatarjax.nets.functional import Params
from avatarjax.smad import hull, voxels
from avatarjax.smad import volume_rendering as volume
from avatarjax.smad.hull import Hull, HullConfig
from avatarjax.smad.volume_rendering import Light, Rays
from avatarjax.smad.voxels import Grid

# Before training a voxel takes so much of the light that crosses it: outside of the hull, and inside.
_OUTSIDE, _INSIDE = 0.002, 0.03
# Adam moves every parameter by about the learning rate: values of the grid must travel further than weights do.
_TRAVEL = 40.0


@dataclasses.dataclass(frozen=True)
class FieldConfig:
    """Sizes of the field and of its training; all numbers are ours, the paper gives none.

    cells: voxels along the longest side of the hull; margin: by so many more the box reaches beyond it. fraction: in so
    many of the silhouettes lie the voxels of that hull. point_bands, time_bands: octaves of sines and cosines.
    offset_bound: how far the network may move a point, metres. samples: on each ray, placed by `probes` looks at the
    hull: outside of it there are `stray` times as many per metre. rays: in a training step. silhouette: the weight of
    that loss. kappa: the threshold on the average density, as depth of one voxel: 0.3 takes a quarter of the light.
    gaussians, opacity: how many come out, and what they are given.
    """

    cells: int = 80
    width: int = 64
    layers: int = 3
    point_bands: int = 3
    time_bands: int = 4
    offset_bound: float = 0.3
    samples: int = 48
    probes: int = 32
    stray: float = 0.1
    margin: int = 4
    fraction: float = 0.6
    rays: int = 768
    silhouette: float = 0.1
    learning_rate: float = 2e-3
    steps: int = 2000
    kappa: float = 0.3
    gaussians: int = 5000
    opacity: float = 0.8

    def __post_init__(self):
        for name in ("cells", "width", "samples", "probes", "rays", "steps", "gaussians"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be positive")
        for name in ("offset_bound", "stray", "kappa", "learning_rate"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be positive")


class Deformation(nnx.Module):
    """Where points that are seen at a time lie in the canonical space, as an offset, which is zero before training."""

    def __init__(self, config: FieldConfig, *, rngs: nnx.Rngs):
        width = config.width
        self.point = nnx.Linear(3 * (1 + 2 * config.point_bands), width, rngs=rngs)
        self.time = nnx.Linear(1 + 2 * config.time_bands, width, use_bias=False, rngs=rngs)
        self.layers = nnx.List([nnx.Linear(width, width, rngs=rngs) for _ in range(config.layers - 1)])
        self.leave = nnx.Linear(width, 3, kernel_init=nnx.initializers.zeros, rngs=rngs)
        self.bands = config.point_bands, config.time_bands
        self.bound = config.offset_bound

    def __call__(self, points: Float[Array, "n s 3"], times: Float[Array, " n"]) -> Float[Array, "n s 3"]:
        """Offsets in metres of points in the box, scaled to -1..1, of n rays of one time each, 0..1."""
        # What a ray's points share is computed once.
        x = self.point(octaves(points, self.bands[0])) + self.time(octaves(times[:, None], self.bands[1]))[:, None]
        for layer in self.layers:
            x = layer(jax.nn.relu(x))
        return self.bound * jnp.tanh(self.leave(jax.nn.relu(x)))


def space(masks: Bool[np.ndarray, "f h w"], cameras: Camera, config: FieldConfig) -> Hull:
    """The box of a field, and where in it samples are worth most: a generous hull of the silhouettes (f, h, w).

    `cameras` (f,) are those of the body frame. Raises ValueError as `hull.carve` does.
    """
    carved = hull.carve(masks, cameras, HullConfig(resolution=max(4, config.cells), fraction=config.fraction))
    margin, edge = config.margin, carved.grid.edge
    occupied = ndimage.binary_dilation(np.pad(np.asarray(carved.occupied), margin), iterations=max(1, margin // 2))
    grid = Grid(carved.grid.low - margin * edge, edge, occupied.shape)
    return Hull(grid, jnp.asarray(occupied))


def init(config: FieldConfig, where: Hull, key: Key[Array, ""]) -> Params:
    """Fresh parameters of a field: grey, at rest, a thin mist in the hull and nearly nothing around it."""
    start = (_bias(_INSIDE) - _bias(_OUTSIDE)) / _TRAVEL
    values = jnp.zeros((*where.grid.shape, 4)).at[..., 0].set(jnp.where(where.occupied, start, 0.0))
    return {"network": functional.init(Deformation, config, key), "grid": values}


def canonical(
    config: FieldConfig, params: Params, grid: Grid, points: Float[Array, "n s 3"], times: Float[Array, " n"]
) -> Float[Array, "n s 3"]:
    """Where points of the body frame, seen at times (n,) in 0..1, lie in the canonical space; metres."""
    half = 0.5 * jnp.max(grid.high - grid.low)
    scaled = (points - 0.5 * (grid.low + grid.high)[None, None]) / half
    return points + functional.bind(Deformation, config, params["network"])(scaled, times)


def sample(
    config: FieldConfig, params: Params, grid: Grid, points: Float[Array, "n s 3"], times: Float[Array, " n"]
) -> tuple[Float[Array, "n s"], Float[Array, "n s 3"]]:
    """sigma(x, t), per metre, and colour of points of the body frame at times (n,) in 0..1; nothing outside the box."""
    places = canonical(config, params, grid, points, times)
    values, inside = _interpolate(grid, params["grid"], places.reshape(-1, 3))
    depth = jax.nn.softplus(_TRAVEL * values[:, 0] + _bias(_OUTSIDE))
    density = jnp.where(inside, depth / grid.edge, 0.0)
    return density.reshape(points.shape[:2]), jax.nn.sigmoid(_TRAVEL * values[:, 1:]).reshape(points.shape)


def render(
    config: FieldConfig,
    params: Params,
    where: Hull,
    rays: Rays,
    times: Float[Array, " n"],
    key: Key[Array, ""] | None = None,
) -> Light:
    """What rays in the body frame at times (n,) in 0..1 see of the field; random samples with a key, else middles."""
    probes, _ = volume.stratify(rays, config.probes, None)
    hits = voxels.lookup(where.grid, where.occupied, volume.points(rays, probes).reshape(-1, 3))
    wanted = jnp.where(hits, 1.0, config.stray).reshape(probes.shape)
    distances, lengths = volume.stratify(rays, config.samples, key, wanted)
    density, colors = sample(config, params, where.grid, volume.points(rays, distances), times)
    return volume.composite(density, colors, lengths)


def time_average(
    config: FieldConfig, params: Params, grid: Grid, times: Float[Array, " t"]
) -> tuple[Float[Array, "x y z"], Float[Array, "x y z 3"]]:
    """The mean density over times in 0..1, (1 / T) sum sigma(x, t), per metre, and the colours it is seen in.

    x is a point of the body frame: that of the canonical grid itself would be the same at all times. Colours are means
    weighed by density.
    """
    slabs = grid.centres.reshape(grid.shape[0], -1, 3)

    def average(slab):
        def add(total, time):
            density, colors = sample(config, params, grid, slab[None], time[None])
            return (total[0] + density[0], total[1] + density[0][:, None] * colors[0]), None

        zeros = jnp.zeros(len(slab)), jnp.zeros((len(slab), 3))
        return jax.lax.scan(add, zeros, times)[0]

    density, light = jax.lax.map(average, slabs)
    colors = light / jnp.maximum(density, 1e-12)[..., None]
    return density.reshape(grid.shape) / len(times), colors.reshape(*grid.shape, 3)


def extract(config: FieldConfig, params: Params, grid: Grid, times: Float[Array, " t"]) -> Gaussians:
    """Canonical Gaussians G^c: the voxels of an average density above kappa, clustered (SMAD 3, PGI).

    Voxels with none but such around them are left out: no ray ends there, so that nothing has told their colour.
    Raises ValueError where too few voxels are dense.
    """
    density, colors = jax.jit(time_average, static_argnums=0)(config, params, grid, times)
    depth = np.asarray(density) * float(grid.edge)
    dense = np.asarray(ndimage.binary_fill_holes(depth > config.kappa))
    if not dense.any():
        raise ValueError(f"no voxel is as deep as kappa = {config.kappa}, the deepest {depth.max():.3g}: train longer")
    shell = voxels.surface(dense).reshape(-1)
    points = np.asarray(grid.centres)[shell]
    return voxels.to_gaussians(points, np.asarray(colors).reshape(-1, 3)[shell], config.gaussians, config.opacity)


def _bias(share: float) -> float:
    """What softplus makes a depth of that takes this share of the light."""
    return float(np.log(np.expm1(-np.log1p(-share))))


def _interpolate(
    grid: Grid, values: Float[Array, "x y z c"], points: Float[Array, "n 3"]
) -> tuple[Float[Array, "n c"], Bool[Array, " n"]]:
    """Values between the middles of voxels, trilinear, and whether points are inside of the box."""
    shape = np.array(grid.shape)
    place = (points - grid.low[None]) / grid.edge - 0.5
    inside = jnp.all((place > -0.5) & (place < jnp.asarray(shape - 0.5)[None]), -1)
    place = jnp.clip(place, 0.0, jnp.asarray(shape - 1, jnp.float32)[None])
    corner = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, jnp.asarray(np.maximum(shape - 2, 0), jnp.int32)[None])
    share = place - corner
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    base = jnp.sum(corner * jnp.asarray(strides, jnp.int32)[None], -1)
    rows, weights = [], []
    for step in itertools.product((0, 1), repeat=3):
        rows.append(base + int(np.dot(np.minimum(step, shape - 1), strides)))
        weights.append(jnp.prod(jnp.where(jnp.asarray(step, bool)[None], share, 1 - share), -1))
    # One gather of all corners: its gradient is one scatter.
    found = values.reshape(-1, values.shape[-1])[jnp.stack(rows, -1)]
    return jnp.einsum("nk,nkc->nc", jnp.stack(weights, -1), found), inside
