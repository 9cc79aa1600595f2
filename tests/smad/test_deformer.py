"""The deformation network: factored against plain edges, symmetries, published sizes, and what must not matter."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.nets import functional
from avatarjax.smad import deformer
from avatarjax.smad import graph as graphs
from avatarjax.smad.config import DeformerConfig
from avatarjax.smad.deformer import Deformer, PlainDeformer
from tests.parameters import random_like

CONFIG = DeformerConfig(
    pose=5, pose_window=2, pose_width=8, pose_embedding=6, velocities=3, node_features=2, hidden=12, message=7,
    iterations=2, decoder=(10, 9), codes=4, strain=True,
)  # fmt: skip
COUNT = 30


@pytest.fixture(scope="module")
def graph():
    return graphs.build(np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32), 4)


def random_params(config, graph, seed=0):
    """Parameters with normal entries, so that the heads and every switch do something."""
    return random_like(jax.eval_shape(lambda: deformer.init(config, graph, jax.random.key(0))), seed, 0.5)


def inputs(config, graph, seed=1):
    rng = np.random.default_rng(seed)
    count = len(graph.positions)
    shapes = (config.pose_window, config.pose), (count, 3), (count, config.velocities, 3), (count, config.node_features)
    return [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes]


def deform(config, params, graph, *given, network=Deformer):
    return jax.jit(deformer.deform, static_argnums=0, static_argnames="network")(
        config, params, graph, *given, network=network
    )


def doubled(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def assert_close(found, expected, **tolerance):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **tolerance), found, expected)


NO_HISTORY = {"velocities": 0, "strain": False, "codes": 0, "adaptive_stiffness": False, "aggregation": "adjacency"}
VANILLA = {"edge_features": False, "strain": False, "node_features": 0, "iterations": 1}


@pytest.mark.parametrize("changes", [{}, NO_HISTORY, VANILLA], ids=["full", "no history", "vanilla"])
def test_factored_edges_equal_plain_ones_in_float64(graph, changes):
    """To 1e-12, the outputs and the gradients by parameters, positions and velocities."""
    config = dataclasses.replace(CONFIG, **changes)
    params = random_params(config, graph)
    with jax.enable_x64(True):
        arguments = doubled((params, graph, *inputs(config, graph)))

        def loss(floats, graph, network):
            out = deformer.deform(config, floats[0], graph, *floats[1:], network=network)
            return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(out)), out

        both = jax.jit(jax.grad(loss, has_aux=True), static_argnums=2)
        (params, graph, *given) = arguments
        found, expected = (both((params, *given), graph, network) for network in (Deformer, PlainDeformer))
        assert all(x.dtype == np.float64 for x in jax.tree.leaves(found))
        assert_close(found, expected, rtol=1e-11, atol=1e-12)


def test_in_float32_they_agree_to_rounding(graph):
    params, given = random_params(CONFIG, graph), inputs(CONFIG, graph)
    found, expected = (deform(CONFIG, params, graph, *given, network=net) for net in (Deformer, PlainDeformer))
    assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_forward_builds_no_array_of_messages(graph):
    params, given = random_params(CONFIG, graph), inputs(CONFIG, graph)
    widest = {}
    for network in (Deformer, PlainDeformer):
        jaxpr = jax.make_jaxpr(lambda *a, n=network: deformer.deform(CONFIG, *a, network=n))(params, graph, *given)
        widest[network] = max(equation.outvars[0].aval.size for equation in _equations(jaxpr.jaxpr))
    degree = graph.neighbours.shape[1]
    assert widest[PlainDeformer] >= COUNT * degree * CONFIG.edge_inputs
    assert widest[Deformer] < COUNT * degree * CONFIG.message


def _equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: hasattr(x, "eqns")):
            if hasattr(inner, "eqns") or hasattr(inner, "jaxpr"):
                yield from _equations(getattr(inner, "jaxpr", inner))


def test_numbering_the_nodes_otherwise_numbers_the_answers_otherwise(graph):
    order = np.random.default_rng(2).permutation(COUNT)
    config = dataclasses.replace(CONFIG, adaptive_stiffness=False)
    params, (pose, *given) = random_params(config, graph), inputs(config, graph)
    here = deform(config, params, graph, pose, *given)
    moved = {**params, "codes": params["codes"][order]}
    there = deform(config, moved, graphs.build(np.asarray(graph.positions)[order], 4), pose, *(x[order] for x in given))
    assert_close(there, jax.tree.map(lambda x: x[order], here), rtol=1e-4, atol=1e-5)


def test_padding_has_no_influence(graph):
    """Three more columns that name other nodes, in every row."""
    wider = graph.replace(
        **{
            name: jnp.pad(getattr(graph, name), ((0, 0), (0, 3)), constant_values=value)
            for name, value in {"neighbours": 7, "mask": False, "adjacency": 0, "lengths": 5, "edge_ids": 3}.items()
        }
    )
    for aggregation in ("mean", "adjacency"):
        config = dataclasses.replace(CONFIG, aggregation=aggregation)
        params, given = random_params(config, graph), inputs(config, graph)
        assert_close(deform(config, params, wider, *given), deform(config, params, graph, *given), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("aggregation", ["mean", "adjacency"])
def test_a_sum_of_messages_by_hand(aggregation):
    """Three nodes in a row at 0, 1 and 3: the middle one hears of both, the outer ones of it alone."""
    row = graphs.build(np.asarray([[0, 0, 0], [1, 0, 0], [3, 0, 0]], np.float32), 1, bandwidth=2.0)
    config = dataclasses.replace(CONFIG, aggregation=aggregation, adaptive_stiffness=False)
    weights = functional.bind(Deformer, config, random_params(config, row)["network"])._weights(row, None, jnp.float32)
    message = np.asarray([1.0, 10.0, 100.0])
    summed = np.sum(np.asarray(weights) * message[np.asarray(row.neighbours)], axis=1)
    near, far = np.exp(-1 / 4), np.exp(-4 / 4)
    expected = {"mean": [10.0, (1 + 100) / 2, 10.0], "adjacency": [10 * near, near + 100 * far, 10 * far]}
    np.testing.assert_allclose(summed, expected[aggregation], rtol=1e-6)


def test_stiffness_weighs_the_messages_of_its_edge(graph):
    """An edge without stiffness is no edge: its ends hear no more of each other in one iteration."""
    config = dataclasses.replace(CONFIG, iterations=1)
    params, (pose, x, v, f) = random_params(config, graph), inputs(config, graph)
    i, j = np.asarray(graph.edges[0])
    cut = {**params, "log_stiffness": params["log_stiffness"].at[0].set(-jnp.inf)}
    for given, heard in ((params, True), (cut, False)):
        here, there = (deform(config, given, graph, pose, x, v, g) for g in (f, f.at[j].add(1.0)))
        assert bool(jnp.any(here.position[i] != there.position[i])) == heard


def test_messages_reach_as_far_as_there_are_iterations(graph):
    params, (pose, x, v, f) = random_params(CONFIG, graph), inputs(CONFIG, graph)
    here, there = (deform(CONFIG, params, graph, pose, x, v, g) for g in (f, f.at[0].add(1.0)))
    near = np.eye(COUNT, dtype=bool)[0]
    for _ in range(CONFIG.iterations):
        closer, near = near, near | np.any(near[np.asarray(graph.neighbours)] & np.asarray(graph.mask), axis=1)
    changed = np.any(here.position != there.position, axis=1)
    assert not changed[~near].any() and changed[near & ~closer].any()


def test_without_iterations_no_node_hears_of_another(graph):
    config = dataclasses.replace(CONFIG, iterations=0)
    params, (pose, x, v, f) = random_params(config, graph), inputs(config, graph)
    here, there = (deform(config, params, graph, pose, x, v, g) for g in (f, f.at[0].add(1.0)))
    np.testing.assert_array_equal(np.any(here.position != there.position, axis=1), np.arange(COUNT) == 0)


def test_published_sizes():
    """Tables G and H by hand, with the head for opacity that only Eq. 8 has."""
    config = DeformerConfig(adaptive_stiffness=False, codes=0)
    shapes = functional.shapes(Deformer, config)
    embedding = (8 * 72 * 256 + 256 + 512) + 2 * (256 * 256 + 256 + 512) + (256 * 128 + 128)
    assert functional.count(shapes["pose"]) == embedding
    projection = (3 + 3 * 12 + 128) * 256 + 256
    messages = 519 * 128 + 128
    gru = (128 + 256) * 768 + 2 * 768
    decoder = (256 * 256 + 256) + (256 * 128 + 128)
    heads = 4 * (128 * 3 + 3) + (128 + 1)
    assert functional.count(shapes) == embedding + projection + messages + gru + decoder + heads


def test_codes_and_stiffness_are_one_for_each_node_and_edge(graph):
    params = random_params(CONFIG, graph)
    assert params["codes"].shape == (COUNT, CONFIG.codes)
    assert params["log_stiffness"].shape == (len(graph.edges),)
    assert set(random_params(dataclasses.replace(CONFIG, codes=0, adaptive_stiffness=False), graph)) == {"network"}


def test_a_code_changes_the_look_of_its_gaussian_and_no_motion(graph):
    params, given = random_params(CONFIG, graph), inputs(CONFIG, graph)
    other = {**params, "codes": params["codes"].at[3].add(1.0)}
    here, there = deform(CONFIG, params, graph, *given), deform(CONFIG, other, graph, *given)
    for name in ("position", "velocity"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
    for name in ("log_scales", "colors", "logit_opacities"):
        changed = np.asarray(getattr(here, name) != getattr(there, name)).reshape(COUNT, -1).any(1)
        np.testing.assert_array_equal(changed, np.arange(COUNT) == 3)


def test_an_untrained_network_changes_next_to_nothing(graph):
    config = dataclasses.replace(CONFIG, iterations=0)
    params = deformer.init(config, graph, jax.random.key(0))
    for leaf in jax.tree.leaves(deform(config, params, graph, *inputs(config, graph))):
        assert 0 < np.abs(leaf).max() < 0.05


def test_a_change_of_colour_is_bounded_and_goes_both_ways(graph):
    """By twice the published sigmoid less one."""
    params, given = random_params(CONFIG, graph), inputs(CONFIG, graph)
    head = params["network"]["heads"]["colors"]
    linear = {**head, "bias": jnp.asarray([-3.0, 0.0, 3.0]), "kernel": jnp.zeros_like(head["kernel"])}
    params["network"]["heads"]["colors"] = linear
    expected = 2 / (1 + np.exp([3.0, 0.0, -3.0])) - 1
    np.testing.assert_allclose(deform(CONFIG, params, graph, *given).colors[5], expected, atol=1e-6)


def test_gradients_reach_every_parameter(graph):
    params, given = random_params(CONFIG, graph), inputs(CONFIG, graph)

    def loss(params):
        return sum(jnp.sum(x**2) for x in jax.tree.leaves(deformer.deform(CONFIG, params, graph, *given)))

    for leaf in jax.tree.leaves(jax.jit(jax.grad(loss))(params)):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0


def test_many_states_at_once_equal_one_after_the_other(graph):
    params = random_params(CONFIG, graph)
    several = [inputs(CONFIG, graph, seed) for seed in (1, 2)]
    stacked = [jnp.stack(x) for x in zip(*several, strict=True)]
    together = jax.jit(jax.vmap(lambda *given: deformer.deform(CONFIG, params, graph, *given)))(*stacked)
    for k, given in enumerate(several):
        one = deform(CONFIG, params, graph, *given)
        assert_close(jax.tree.map(lambda x, k=k: x[k], together), one, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("place, name", [(0, "pose"), (2, "velocities"), (3, "features")])
def test_wrong_shapes_are_refused_by_name(graph, place, name):
    given = inputs(CONFIG, graph)
    given[place] = given[place][:, 1:]
    with pytest.raises(ValueError, match=rf"{name} \(.*must be \("):
        deformer.deform(CONFIG, random_params(CONFIG, graph), graph, *given)


def test_nodes_of_another_graph_are_refused(graph):
    pose, *given = inputs(CONFIG, graph)
    with pytest.raises(ValueError, match=r"positions \(29, 3\) must be \(30, 3\)"):
        deformer.deform(CONFIG, random_params(CONFIG, graph), graph, pose, *(x[1:] for x in given))
