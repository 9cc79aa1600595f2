"""SMAD's configuration: presets, what is refused, and the sizes that follow."""

import dataclasses

import jaxtyping
import pytest

from avatarjax.smad import PRESETS, SmadConfig, preset
from avatarjax.smad.config import DeformerConfig
from avatarjax.smad.graph import GraphConfig


@pytest.mark.parametrize(("name", "nodes"), [("ci", 300), ("small", 2_000), ("base", 40_000), ("paper", 40_000)])
def test_presets_have_the_nodes_of_the_design(name, nodes):
    assert preset(name).graph.nodes == nodes


def test_presets_are_hashable_and_the_paper_is_the_default():
    assert len({preset(name) for name in PRESETS}) == 3
    assert preset("paper") == SmadConfig()


def test_a_preset_takes_changes():
    assert preset("ci", graph=GraphConfig(nodes=50)).graph.nodes == 50


def test_an_unknown_preset_is_refused_by_name():
    with pytest.raises(ValueError, match="'tiny': choose one of ci, small, base, paper"):
        preset("tiny")


def test_an_edge_has_519_features_as_published():
    assert DeformerConfig().edge_inputs == 519


@pytest.mark.parametrize(
    ("changes", "inputs"),
    [({"velocities": 0}, 516), ({"edge_features": False}, 512), ({"strain": True}, 520)],
)
def test_an_edge_has_fewer_or_more_features_in_ablations(changes, inputs):
    assert dataclasses.replace(DeformerConfig(), **changes).edge_inputs == inputs


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hidden": 0}, "hidden is 0"),
        ({"codes": -1}, "codes is -1"),
        ({"aggregation": "max"}, "'max'"),
        ({"strain": True, "edge_features": False}, "needs edge_features"),
    ],
)
def test_sizes_that_make_no_network_are_refused(changes, message):
    # The import hook refuses a name that is not among a type's before the class itself does.
    with pytest.raises((ValueError, jaxtyping.TypeCheckError), match=message):
        DeformerConfig(**changes)


def test_a_graph_of_too_few_nodes_is_refused():
    with pytest.raises(ValueError, match="more nodes than 16"):
        GraphConfig(nodes=16)


def test_an_unknown_motion_is_refused():
    with pytest.raises((ValueError, jaxtyping.TypeCheckError), match="'flying'"):
        dataclasses.replace(preset("ci"), motion="flying")
