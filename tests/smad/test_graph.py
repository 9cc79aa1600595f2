"""The Gaussian graph against brute force, and what must not matter to it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.smad import graph as graphs

K = 4


@pytest.fixture(scope="module")
def cloud():
    return np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def graph(cloud):
    return graphs.build(cloud, K, bandwidth=0.7)


def joined(graph):
    """The dense matrix (n, n) of what is in the table, by receiver and sender."""
    count = len(graph.positions)
    dense = np.zeros((count, count), bool)
    rows, columns = np.nonzero(graph.mask)
    dense[rows, np.asarray(graph.neighbours)[rows, columns]] = True
    return dense


def test_downsampling_equals_a_loop_over_voxels(cloud):
    errors = np.random.default_rng(1).integers(0, 4, len(cloud)).astype(np.float64)
    nodes = graphs.downsample(cloud, errors, 0.8)
    cells = np.floor((cloud.astype(np.float64) - cloud.min(0)) / 0.8)
    seen = {}
    for i, cell in enumerate(map(tuple, cells)):
        seen.setdefault(cell, []).append(i)
    assert len(nodes.positions) == len(seen) < len(cloud)
    for m, cell in enumerate(sorted(seen)):
        members = seen[cell]
        np.testing.assert_allclose(nodes.positions[m], cloud[members].astype(np.float64).mean(0), atol=1e-12)
        assert nodes.kept[m] == min(members, key=lambda i: (errors[i], i))
        assert (nodes.node[members] == m).all()


def test_downsampling_does_not_depend_on_the_order_of_the_gaussians(cloud):
    rng = np.random.default_rng(2)
    errors, order = rng.normal(size=len(cloud)), rng.permutation(len(cloud))
    here, there = graphs.downsample(cloud, errors, 0.8), graphs.downsample(cloud[order], errors[order], 0.8)
    np.testing.assert_allclose(there.positions, here.positions, atol=1e-12)
    np.testing.assert_array_equal(order[there.kept], here.kept)
    np.testing.assert_array_equal(there.node, here.node[order])


def test_downsampling_does_not_depend_on_place_and_scale(cloud):
    cloud = cloud.astype(np.float64)
    errors = np.zeros(len(cloud))
    here = graphs.downsample(cloud, errors, 0.8)
    there = graphs.downsample(2 * cloud + [8.0, -4.0, 16.0], errors, 1.6)
    np.testing.assert_array_equal(there.node, here.node)
    np.testing.assert_allclose(there.positions, 2 * here.positions + [8.0, -4.0, 16.0], atol=1e-12)


@pytest.mark.parametrize("nodes", [1, 40, 400, 2000])
def test_the_edge_for_a_count_leaves_about_so_many_nodes(nodes):
    shell = np.random.default_rng(3).normal(size=(2000, 3))
    shell /= np.linalg.norm(shell, axis=1, keepdims=True)
    edge = graphs.edge_for_count(shell, nodes)
    assert len(graphs.downsample(shell, np.zeros(2000), edge).positions) == pytest.approx(nodes, rel=0.02, abs=2)


def test_the_overlap_edge_leaves_a_tenth_of_a_dense_shell():
    """A sphere's shell of splats two standard deviations apart, two voxels of them thick, as a density field has it."""
    sigma = 0.01
    grid = np.stack(np.meshgrid(*3 * [np.arange(-0.5, 0.5, 2 * sigma)], indexing="ij"), -1).reshape(-1, 3)
    shell = grid[np.abs(np.linalg.norm(grid, axis=1) - 0.45) < 2 * sigma]
    edge = graphs.overlap_edge(np.full((len(shell), 3), np.log(sigma)))
    assert edge == pytest.approx(6 * sigma)
    nodes = graphs.downsample(shell, np.zeros(len(shell)), edge)
    assert 7 < len(shell) / len(nodes.positions) < 14


def test_edges_are_those_of_brute_force(cloud, graph):
    distance = np.linalg.norm(cloud[:, None] - cloud[None], axis=2)
    near = np.zeros_like(distance, bool)
    for i, row in enumerate(distance + 1e9 * np.eye(len(cloud))):
        near[i, np.argsort(row)[:K]] = True
    np.testing.assert_array_equal(joined(graph), near | near.T)


def test_the_table_is_symmetric_and_its_degrees_are_true(graph):
    dense = joined(graph)
    np.testing.assert_array_equal(dense, dense.T)
    assert not dense.diagonal().any()
    np.testing.assert_array_equal(graph.degree, dense.sum(1))
    assert graph.degree.min() >= K and graph.neighbours.shape[1] == graph.degree.max()


def test_padding_is_the_receiver_itself_and_counts_for_nothing(graph):
    rows, columns = np.nonzero(~np.asarray(graph.mask))
    assert len(rows)
    np.testing.assert_array_equal(np.asarray(graph.neighbours)[rows, columns], rows)
    assert not np.asarray(graph.adjacency)[rows, columns].any() and not np.asarray(graph.lengths)[rows, columns].any()


def test_the_list_of_pairs_holds_each_entry_of_the_table_once(graph):
    edges = np.asarray(graph.edges)
    assert (edges[:, 0] < edges[:, 1]).all() and 2 * len(edges) == graph.degree.sum()
    rows, columns = np.nonzero(graph.mask)
    table = np.sort(np.stack([rows, np.asarray(graph.neighbours)[rows, columns]], axis=1), axis=1)
    np.testing.assert_array_equal(edges[np.asarray(graph.edge_ids)[rows, columns]], table)


def test_adjacency_is_the_gaussian_of_the_distance(cloud, graph):
    offset = cloud[:, None] - cloud[np.asarray(graph.neighbours)]
    expected = np.exp(-np.sum(offset**2, axis=2) / 0.7**2) * np.asarray(graph.mask)
    np.testing.assert_allclose(graph.adjacency, expected, atol=1e-6)


def test_the_bandwidth_left_open_is_the_mean_length(cloud, graph):
    ends = np.asarray(graph.positions)[np.asarray(graph.edges)]
    mean = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
    np.testing.assert_allclose(
        graphs.build(cloud, K).adjacency, graphs.build(cloud, K, bandwidth=mean).adjacency, atol=1e-6
    )


def test_the_same_cloud_gives_the_same_graph(cloud, graph):
    again = graphs.build(cloud.copy(), K, bandwidth=0.7)
    jax.tree.map(np.testing.assert_array_equal, again, graph)


def test_the_graph_of_permuted_nodes_is_permuted(cloud, graph):
    order = np.random.default_rng(4).permutation(len(cloud))
    there = joined(graphs.build(cloud[order], K, bandwidth=0.7))
    np.testing.assert_array_equal(there, joined(graph)[np.ix_(order, order)])


def test_turning_and_moving_the_cloud_changes_nothing_but_positions(cloud, graph):
    turn, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    moved = graphs.build((cloud @ turn.T + [0.5, 1.0, -2.0]).astype(np.float32), K, bandwidth=0.7)
    np.testing.assert_array_equal(moved.neighbours, graph.neighbours)
    np.testing.assert_allclose(moved.lengths, graph.lengths, atol=2e-6)
    np.testing.assert_allclose(moved.adjacency, graph.adjacency, atol=5e-6)


def test_distances_at_rest_are_the_rest_lengths(graph):
    np.testing.assert_allclose(graphs.distances(graph, graph.positions), graph.lengths, atol=1e-6)


def test_distances_of_coincident_nodes_have_a_finite_gradient(graph):
    slope = jax.grad(lambda x: jnp.sum(graphs.distances(graph, x)))(jnp.zeros_like(graph.positions))
    assert np.isfinite(slope).all()


def test_coincident_nodes_are_no_neighbours_of_themselves():
    graph = graphs.build(np.zeros((8, 3), np.float32), 3)
    assert not joined(graph).diagonal().any() and graph.degree.min() >= 3
    assert np.isfinite(graph.adjacency).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda x: graphs.build(x[:4], 4), "more nodes than 4"),
        (lambda x: graphs.build(x, 0), "more nodes"),
        (lambda x: graphs.build(x[:0], 1), "n > 0"),
        (lambda x: graphs.build(np.where(x > 1, np.nan, x), K), "not finite"),
        (lambda x: graphs.build(x, K, bandwidth=0.0), "bandwidth 0.0"),
        (lambda x: graphs.downsample(x, np.zeros(len(x)), 0.0), "side 0.0"),
        (lambda x: graphs.downsample(x, np.zeros(len(x)), 1e-9), "too small"),
        (lambda x: graphs.downsample(x, np.full(len(x), np.nan), 1.0), "finite number"),
        (lambda x: graphs.edge_for_count(x, len(x) + 1), "cannot be downsampled"),
        (lambda x: graphs.overlap_edge(x[:0]), "not empty"),
    ],
)
def test_bad_input_is_refused(cloud, make, message):
    with pytest.raises(ValueError, match=message):
        make(cloud)
