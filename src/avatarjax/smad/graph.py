"""The Gaussian graph (SMAD 3.1, B.1): which Gaussians become nodes, and which nodes are neighbours.

Built once, offline, in NumPy; consumed in JAX as a pytree of static shapes. Neighbourhood and adjacency are those of
the canonical space and stay so: the paper's A_ij(t) names a time and never says how it would change.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from avatarjax.gaussians import Gaussians

# Voxels along the longest side of the cloud: three such counts fit into one 64-bit key.
_CELLS = 2**20
# A splat ends, as 3DGS draws it, at so many standard deviations.
_SPLAT_RADIUS = 3.0


@dataclasses.dataclass(frozen=True)
class GraphConfig:
    """How many nodes, and how many nearest neighbours make an edge. bandwidth: rho_a in metres, None for the mean
    length of the edges (ours: the paper has no number)."""

    nodes: int = 40_000
    neighbours: int = 16
    bandwidth: float | None = None

    def __post_init__(self):
        if not 1 <= self.neighbours < self.nodes:
            raise ValueError(f"{self.neighbours} neighbours need more nodes than {self.nodes}")


@typing.no_type_check
@flax.struct.dataclass
class Graph:
    """An undirected graph over n nodes, once as a padded table by receiver and once as a list of pairs.

    positions (n, 3) at rest, metres. Row i of neighbours (n, d) lists the nodes that send to i in rising order, then
    i itself where mask (n, d) is False; degree (n,) counts them. adjacency (n, d) is A_ij, 0 on padding; lengths (n, d)
    the distance at rest in metres, 0 on padding. edges (e, 2) holds each pair once, lower id first, and edge_ids (n, d)
    the row of `edges` behind each entry of the table, 0 on padding.
    """

    positions: Float[Array, "n 3"]
    neighbours: Int[Array, "n d"]
    mask: Bool[Array, "n d"]
    degree: Int[Array, "n"]
    adjacency: Float[Array, "n d"]
    lengths: Float[Array, "n d"]
    edges: Int[Array, "e 2"]
    edge_ids: Int[Array, "n d"]


class Nodes(typing.NamedTuple):
    """m nodes of n Gaussians: positions (m, 3), the Gaussian kept (m,) for each, and the node (n,) of each Gaussian."""

    positions: Float[np.ndarray, "m 3"]
    kept: Int[np.ndarray, " m"]
    node: Int[np.ndarray, " n"]


def downsample(positions: Float[np.ndarray, "n 3"], errors: Float[np.ndarray, " n"], edge: float) -> Nodes:
    """One node for each voxel of side `edge` metres that holds a Gaussian (SMAD B.1), in the order of the voxels.

    In each voxel the Gaussian of the smallest error is kept (of equal ones the first), and with it what cannot be
    averaged: rotation, colour, opacity. The paper then pools "the surviving indices" by their average, of which each
    voxel has one; we read it as the voxel grid that it cites (Rusu & Cousins 2011) has it: the node lies at the mean
    position of all Gaussians of its voxel. Raises ValueError for empty or non-finite input.
    """
    positions = _checked(positions)
    if errors.shape != positions.shape[:1] or not np.isfinite(errors).all():
        raise ValueError(f"errors {errors.shape} must be one finite number for each of {len(positions)} Gaussians")
    _, node = np.unique(_keys(positions, edge), return_inverse=True)
    order = np.lexsort((errors, node))
    kept = order[np.flatnonzero(np.diff(node[order], prepend=-1))]
    sums = np.stack([np.bincount(node, positions[:, c]) for c in range(3)], axis=1)
    return Nodes(sums / np.bincount(node)[:, None], kept, node)


def overlap_edge(log_scales: Float[np.ndarray, "n 3"]) -> float:
    """The voxel's side by the paper's rule s = 2 d_min, d_min the radius at which a splat of median size ends.

    Three standard deviations, as 3DGS cuts its splats off: Gaussians of a dense shell then lie about ten to a voxel, as
    the paper finds.
    """
    if not len(log_scales) or not np.isfinite(log_scales).all():
        raise ValueError(f"log-scales {log_scales.shape} must be finite and not empty")
    return 2 * _SPLAT_RADIUS * float(np.exp(np.median(log_scales.mean(axis=1))))


def edge_for_count(positions: Float[np.ndarray, "n 3"], nodes: int, tolerance: float = 0.01) -> float:
    """The voxel's side in metres at which about so many nodes are left, by bisection: within the tolerance where it
    can be met, the nearest that was seen where it cannot.

    Raises ValueError where there are fewer Gaussians than nodes.
    """
    positions = _checked(positions)
    if not 1 <= nodes <= len(positions):
        raise ValueError(f"{len(positions)} Gaussians cannot be downsampled to {nodes} nodes: ask for 1 to as many")
    extent = float(np.ptp(positions, axis=0).max()) or 1.0
    low, high = extent / (_CELLS - 1), 2 * extent
    best, best_miss = high, np.inf
    for _ in range(40):
        edge = np.sqrt(low * high)
        count = len(np.unique(_keys(positions, edge)))
        if abs(count - nodes) < best_miss:
            best, best_miss = edge, abs(count - nodes)
        if best_miss <= tolerance * nodes:
            break
        low, high = (edge, high) if count > nodes else (low, edge)
    return float(best)


def of_gaussians(gaussians: Gaussians, config: GraphConfig) -> Graph:
    """The graph of about `config.nodes` nodes, at most one for each canonical Gaussian; raises ValueError as `build`.

    Of the Gaussians in a voxel the most opaque is kept: no picture tells which of them is wrong.
    """
    means, opaque = np.asarray(gaussians.means), np.asarray(gaussians.logit_opacities, np.float64)
    nodes = downsample(means, -opaque, edge_for_count(means, min(config.nodes, len(means))))
    return build(nodes.positions, config.neighbours, config.bandwidth)


def build(positions: Float[np.ndarray, "n 3"], neighbours: int = 16, bandwidth: float | None = None) -> Graph:
    """The symmetric k-nearest-neighbour graph of nodes at rest (SMAD B.1), with A_ij = exp(-d_ij^2 / bandwidth^2).

    Two nodes are joined where either is among the k nearest of the other, so that degrees vary from k upwards. The
    bandwidth rho_a is in metres; the paper gives no number, None takes the mean length of the edges. Raises ValueError
    for empty or non-finite positions, and for fewer nodes than k + 1.
    """
    # What is stored is what is measured: lengths belong to the rounded positions.
    positions = _checked(np.asarray(positions, np.float32))
    count = len(positions)
    if not 1 <= neighbours < count:
        raise ValueError(f"{neighbours} neighbours need more nodes than {count}: ask for 1 to {count - 1}")
    if bandwidth is not None and not (np.isfinite(bandwidth) and bandwidth > 0):
        raise ValueError(f"bandwidth {bandwidth} must be a positive length in metres")
    edges = _pairs(positions, neighbours)
    length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    adjacency = np.exp(-((length / (bandwidth or max(length.mean(), np.finfo(np.float32).tiny))) ** 2))

    receiver, sender = np.concatenate([edges, edges[:, ::-1]]).T
    edge_id = np.tile(np.arange(len(edges)), 2)
    order = np.lexsort((sender, receiver))
    receiver, sender, edge_id = receiver[order], sender[order], edge_id[order]
    degree = np.bincount(receiver, minlength=count)
    place = np.arange(len(receiver)) - (np.cumsum(degree) - degree)[receiver]
    shape = count, degree.max()

    def table(values, padding):
        filled = np.broadcast_to(padding, shape).copy()
        filled[receiver, place] = values
        return filled

    return Graph(
        positions=jnp.asarray(positions, jnp.float32),
        neighbours=jnp.asarray(table(sender, np.arange(count)[:, None]), jnp.int32),
        mask=jnp.asarray(table(True, False)),
        degree=jnp.asarray(degree, jnp.int32),
        adjacency=jnp.asarray(table(adjacency[edge_id], 0.0), jnp.float32),
        lengths=jnp.asarray(table(length[edge_id], 0.0), jnp.float32),
        edges=jnp.asarray(edges, jnp.int32),
        edge_ids=jnp.asarray(table(edge_id, 0), jnp.int32),
    )


def distances(graph: Graph, positions: Float[Array, "n 3"]) -> Float[Array, "n d"]:
    """How far each neighbour is, metres, wherever the nodes have gone; 0 on padding. Differentiable at distance 0."""
    # One coordinate at a time: an array (n, d, 3) wastes most of a vector register on its last axis.
    offsets = [positions[:, c][graph.neighbours] - positions[:, c, None] for c in range(3)]
    square = sum(d * d for d in offsets)
    apart = square > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)


def _checked(positions: np.ndarray) -> np.ndarray:
    positions = np.asarray(positions, np.float64)
    if positions.ndim != 2 or positions.shape[1] != 3 or not len(positions):
        raise ValueError(f"positions {positions.shape} must be (n, 3) with n > 0")
    if not np.isfinite(positions).all():
        raise ValueError(f"{np.count_nonzero(~np.isfinite(positions).all(axis=1))} positions are not finite: drop them")
    return positions


def _keys(positions: np.ndarray, edge: float) -> np.ndarray:
    """A number for each point's voxel in a grid that begins at the lowest corner of the cloud."""
    if not (np.isfinite(edge) and edge > 0):
        raise ValueError(f"the voxel's side {edge} must be a positive length in metres")
    cell = np.floor((positions - positions.min(axis=0)) / edge)
    if cell.max() >= _CELLS:
        raise ValueError(f"voxels of {edge} m are too small for a cloud of {np.ptp(positions, axis=0).max()} m")
    x, y, z = cell.astype(np.int64).T
    return (x * _CELLS + y) * _CELLS + z


def _pairs(positions: np.ndarray, neighbours: int) -> np.ndarray:
    """Pairs (e, 2), lower id first and sorted, of which one is among the nearest of the other."""
    count = len(positions)
    _, found = cKDTree(positions).query(positions, neighbours + 1)
    own = found == np.arange(count)[:, None]
    # Among many coincident points a node need not find itself: then the last of those found is dropped.
    own[~own.any(axis=1), -1] = True
    sender = found[~own].reshape(count, neighbours)
    receiver = np.repeat(np.arange(count), neighbours)
    pairs = np.sort(np.stack([receiver, sender.reshape(-1)], axis=1), axis=1)
    return np.unique(pairs, axis=0)
