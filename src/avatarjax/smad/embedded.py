"""Gaussians that ride on the nodes of the graph: embedded deformation (Sumner et al. 2007).

In the paper every node is a Gaussian (SMAD 3.1). On a CPU the nodes are few, and Gaussians between them follow the
nodes around: each by the rotations and translations of its nearest nodes, blended. Where Gaussians are the nodes, every
Gaussian follows its own alone.
"""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from avatarjax import rotations
from avatarjax.gaussians import Gaussians
from avatarjax.smad.graph import Graph


@typing.no_type_check
@flax.struct.dataclass
class Binding:
    """By which nodes each of n Gaussians goes: nodes (n, k), the nearest first, and weights (n, k), rows sum to 1."""

    nodes: Int[Array, "n k"]
    weights: Float[Array, "n k"]


def bind(gaussians: Gaussians, graph: Graph, count: int = 4) -> Binding:
    """Bind canonical Gaussians to their `count` nearest nodes, whose weights fall to zero at the distance of the next.

    Raises ValueError where the graph has not so many nodes and one more.
    """
    nodes, means = np.asarray(graph.positions), np.asarray(gaussians.means)
    if len(nodes) <= count:
        raise ValueError(f"{count} nodes for each Gaussian need a graph of more than {len(nodes)} nodes")
    distance, near = cKDTree(nodes).query(means, count + 1)
    reach = np.maximum(distance[:, -1:], 1e-9)
    weights = (1 - distance[:, :-1] / reach) ** 2
    # A Gaussian that is a node has no use for others, and one as far from all as from the next goes by the nearest.
    weights = np.where(distance[:, :1] < 1e-6 * reach, np.eye(count)[:1], weights)
    weights[:, 0] += 1e-9
    weights /= weights.sum(axis=1, keepdims=True)
    return Binding(jnp.asarray(near[:, :-1], jnp.int32), jnp.asarray(weights, jnp.float32))


def turns(graph: Graph, positions: Float[Array, "n 3"]) -> Float[Array, "n 4"]:
    """How the surroundings of each node have turned since rest: the rotation that fits its edges best, as a unit
    quaternion."""
    here, rest = positions, graph.positions
    products = jnp.zeros((len(positions), 3, 3))
    for column in range(graph.neighbours.shape[1]):
        ids, weight = graph.neighbours[:, column], graph.adjacency[:, column]
        now, before = here[ids] - here, rest[ids] - rest
        products = products + weight[:, None, None] * now[:, :, None] * before[:, None]
    # Edges that fit nothing better turn nothing.
    size = jnp.sqrt(jnp.sum(products**2, axis=(1, 2), keepdims=True))
    return rotations.nearest(products + 1e-5 * jnp.maximum(size, 1e-9) * jnp.eye(3)[None])


def carry(
    binding: Binding,
    gaussians: Gaussians,
    graph: Graph,
    positions: Float[Array, "n 3"],
) -> Gaussians:
    """Canonical Gaussians where the nodes have gone."""
    turned = turns(graph, positions)
    matrices = rotations.to_matrix(turned)
    means, quats = jnp.zeros_like(gaussians.means), jnp.zeros_like(gaussians.quats)
    first = turned[binding.nodes[:, 0]]
    for ids, weight in zip(binding.nodes.T, binding.weights.T, strict=True):
        arm = gaussians.means - graph.positions[ids]
        means = means + weight[:, None] * (positions[ids] + jnp.sum(matrices[ids] * arm[:, None], axis=-1))
        # A quaternion and its negative are one rotation: all count on the side of the nearest node's.
        side = jnp.where(jnp.sum(turned[ids] * first, axis=1) < 0, -1.0, 1.0)
        quats = quats + (weight * side)[:, None] * turned[ids]
    return gaussians.replace(means=means, quats=rotations.multiply(rotations.normalize(quats), gaussians.quats))
