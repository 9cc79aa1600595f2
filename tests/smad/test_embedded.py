"""Gaussians that ride on nodes: they turn with them, stay between them, and are left alone where they are nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.gaussians import Gaussians
from avatarjax.smad import embedded, graph

RNG = np.random.default_rng(0)
NODES = RNG.normal(size=(40, 3))
TURN = rotations.normalize(jnp.array([0.8, 0.3, -0.5, 0.2]))
SHIFT = jnp.array([0.5, -1.0, 2.0])


def cloud(means):
    n = len(means)
    quats = rotations.normalize(jnp.asarray(RNG.normal(size=(n, 4)), jnp.float32))
    return Gaussians(
        jnp.asarray(means, jnp.float32), jnp.zeros((n, 3)), quats, jnp.zeros(n), jnp.full((n, 3), 0.5, jnp.float32)
    )


@pytest.fixture(scope="module")
def net():
    return graph.build(NODES, 6)


def moved(points):
    return points @ rotations.to_matrix(TURN).T + SHIFT[None]


def test_a_rigid_motion_of_the_nodes_is_that_of_the_gaussians(net):
    gaussians = cloud(0.7 * RNG.normal(size=(25, 3)))
    carried = embedded.carry(embedded.bind(gaussians, net), gaussians, net, moved(net.positions))
    np.testing.assert_allclose(carried.means, moved(gaussians.means), atol=1e-4)
    expected = rotations.to_matrix(rotations.multiply(jnp.broadcast_to(TURN, (25, 4)), gaussians.quats))
    np.testing.assert_allclose(rotations.to_matrix(carried.quats), expected, atol=1e-4)


def test_gaussians_that_are_nodes_go_where_those_go(net):
    gaussians = cloud(NODES)
    somewhere = jnp.asarray(RNG.normal(size=(40, 3)), jnp.float32)
    binding = embedded.bind(gaussians, net)
    np.testing.assert_allclose(embedded.carry(binding, gaussians, net, somewhere).means, somewhere, atol=1e-5)


def test_at_rest_nothing_changes(net):
    gaussians = cloud(0.7 * RNG.normal(size=(25, 3)))
    carried = embedded.carry(embedded.bind(gaussians, net), gaussians, net, net.positions)
    np.testing.assert_allclose(carried.means, gaussians.means, atol=1e-5)
    np.testing.assert_allclose(rotations.to_matrix(carried.quats), rotations.to_matrix(gaussians.quats), atol=1e-5)


def test_turns_of_a_flat_sheet_are_found():
    sheet = np.stack([*np.meshgrid(np.arange(5.0), np.arange(5.0)), np.zeros((5, 5))], -1).reshape(-1, 3)
    flat = graph.build(sheet, 4)
    found = embedded.turns(flat, moved(flat.positions))
    np.testing.assert_allclose(rotations.to_matrix(found), jnp.tile(rotations.to_matrix(TURN), (25, 1, 1)), atol=1e-2)


def test_gradients_are_finite_at_rest(net):
    gaussians = cloud(0.7 * RNG.normal(size=(25, 3)))
    binding = embedded.bind(gaussians, net)
    slope = jax.grad(lambda x: embedded.carry(binding, gaussians, net, x).quats.sum())(net.positions)
    assert np.isfinite(slope).all()


def test_a_graph_of_too_few_nodes_is_refused():
    with pytest.raises(ValueError, match="more than 4 nodes"):
        embedded.bind(cloud(NODES), graph.build(NODES[:4], 2))
