"""Grids of voxels in the canonical space, and the way from chosen voxels to Gaussians (SMAD 3, baselines)."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from avatarjax.gaussians import Gaussians
from avatarjax.smad import graph

# Round Gaussians at a distance d cover a surface without holes, and widen it least, at about this share of d.
_COVER = 0.45


@typing.no_type_check
@flax.struct.dataclass
class Grid:
    """A box of cubic voxels: the corner low (3,) and the edge of a voxel in metres; shape (x, y, z) is static."""

    low: Float[Array, " 3"]
    edge: Float[Array, ""]
    shape: tuple[int, int, int] = flax.struct.field(pytree_node=False)

    @property
    def high(self) -> Float[Array, " 3"]:
        """The opposite corner."""
        return self.low + self.edge * jnp.asarray(self.shape, jnp.float32)

    @property
    def centres(self) -> Float[Array, "n 3"]:
        """The middles of all voxels, z fastest."""
        axes = [jnp.arange(n, dtype=jnp.float32) + 0.5 for n in self.shape]
        return self.low[None] + self.edge * jnp.stack(jnp.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def fill(low: typing.Any, high: typing.Any, cells: int) -> Grid:
    """A grid of `cells` voxels along the longest side of a box, which it holds whole.

    Raises ValueError for a box without volume.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if low.shape != (3,) or high.shape != (3,) or not np.isfinite(high - low).all() or (high <= low).any():
        raise ValueError(f"a box needs a corner below another, in metres, got {low} and {high}")
    edge = (high - low).max() / cells
    shape = tuple(int(n) for n in np.maximum(np.ceil((high - low) / edge - 1e-6), 1))
    return Grid(jnp.asarray(low, jnp.float32), jnp.asarray(edge, jnp.float32), typing.cast(typing.Any, shape))


def lookup(grid: Grid, values: Array, points: Float[Array, "n 3"]) -> Array:
    """The value (n, ...) of the voxel that holds each point, from values (x, y, z, ...); zero outside of the grid."""
    place = jnp.floor((points - grid.low[None]) / grid.edge).astype(jnp.int32)
    inside = jnp.all((place >= 0) & (place < jnp.asarray(grid.shape)[None]), -1)
    place = jnp.where(inside[:, None], place, 0)
    found = values[place[:, 0], place[:, 1], place[:, 2]]
    return jnp.where(inside.reshape(inside.shape + (1,) * (found.ndim - 1)), found, jnp.zeros((), found.dtype))


def surface(occupied: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Occupied voxels with an empty one behind a face; outside of the grid all is empty."""
    return occupied & ~np.asarray(ndimage.binary_erosion(occupied), bool)


def to_gaussians(
    points: Float[np.ndarray, "n 3"], colors: Float[np.ndarray, "n 3"], count: int, opacity: float
) -> Gaussians:
    """About `count` round Gaussians at the middles of clusters of points, with the mean colours of those.

    Clusters are the points of one voxel of a coarser grid, whose edge is sought; fewer points than `count` are taken
    as they are. Standard deviations follow the distances to the three nearest neighbours. Raises ValueError for fewer
    than four points.
    """
    if len(points) < 4:
        raise ValueError(f"{len(points)} voxels are no surface: use a finer grid or a lower threshold")
    means, colors = _clustered(points, colors, count)
    near, _ = cKDTree(means).query(means, k=min(4, len(means)))
    distance = np.sqrt(np.mean(near[:, 1:] ** 2, axis=1))
    n = len(means)
    return Gaussians(
        means=jnp.asarray(means, jnp.float32),
        log_scales=jnp.asarray(np.repeat(np.log(_COVER * distance)[:, None], 3, axis=1), jnp.float32),
        quats=jnp.zeros((n, 4), jnp.float32).at[:, 0].set(1.0),
        logit_opacities=jnp.full((n,), np.log(opacity / (1 - opacity)), jnp.float32),
        colors=jnp.asarray(np.clip(colors, 0, 1), jnp.float32),
    )


def _clustered(points: np.ndarray, values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean points and values of about `count` clusters, or what was given where there are no more than that."""
    if len(points) <= count:
        return points, values
    nodes = graph.downsample(points, np.zeros(len(points)), graph.edge_for_count(points, count))
    sums = np.stack([np.bincount(nodes.node, channel) for channel in values.T], axis=1)
    return nodes.positions, sums / np.bincount(nodes.node)[:, None]
