"""Turning a group by quarters and exchanging its key is what a recording of a turned world would have given."""

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax import rotations
from avatarjax.data.sequences import Recording
from avatarjax.unica import batches, fit, quarters

YAW = np.array([0.0, 0.02, np.pi - 0.01, np.pi / 2, -np.pi / 2])
MOVES = np.array([0.0, 1, 1, 1, 1])


def turned_world(points, quarter):
    return (points @ np.asarray(rotations.yaw_matrix(jnp.asarray(quarter * np.pi / 2))).T).astype(np.float32)


@pytest.fixture(scope="module")
def recording():
    """Five texels that stand, then run each way, and bob; the surface is of no matter."""
    rng = np.random.default_rng(0)
    frames = 5 * 50
    actions = np.repeat(np.arange(5), 50).astype(np.int32)
    heading = np.stack([np.sin(YAW), 0 * YAW, np.cos(YAW)], -1) * MOVES[:, None]
    roots = np.cumsum(0.05 * heading[actions], axis=0) + np.array([0.3, 1.0, -2.0])
    texels = 0.4 * rng.normal(size=(frames, 5, 3))
    return Recording(texels.astype(np.float32), roots.astype(np.float32), actions, np.repeat(np.arange(5), 50))


@pytest.fixture(scope="module")
def table(recording):
    return quarters.permutations(
        *fit.action_directions(recording.roots[:, [0, 2, 1]], recording.actions, recording.sequence, 5)
    )


@pytest.mark.parametrize("quarter", range(4))
def test_a_turned_group_is_the_group_of_a_turned_world(recording, table, quarter):
    chosen = np.arange(0, 200, 3)
    groups, actions = batches.windows(recording, 4, (0, 25)).groups(chosen, 0.4)
    world = Recording(
        turned_world(recording.texels, quarter),
        turned_world(recording.roots, quarter),
        table[quarter][recording.actions],
        recording.sequence,
    )
    expected, keys = batches.windows(world, 4, (0, 25)).groups(chosen, 0.4)
    np.testing.assert_allclose(quarters.turn(groups, np.full(len(chosen), quarter)), expected, atol=2e-6)
    np.testing.assert_array_equal(table[quarter, actions], keys)
    yaw, moves = fit.action_directions(world.roots[:, [0, 2, 1]], world.actions, world.sequence, 5)
    apart = (yaw - YAW + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(apart[1:], 0, atol=0.04)
    np.testing.assert_array_equal(moves, MOVES)


def test_each_group_has_its_own_turn(recording):
    groups, _ = batches.windows(recording, 4, (0, 25)).groups(np.arange(4), 0.4)
    turned = quarters.turn(groups, np.arange(4))
    for k in range(4):
        np.testing.assert_array_equal(turned[k], quarters.turn(groups[k : k + 1], np.array([k]))[0])
    np.testing.assert_array_equal(turned[0], groups[0])


def test_keys_are_exchanged_as_their_directions_are(table):
    """W (+z) becomes A (+x), S, D; idle stays idle; four quarters are none."""
    np.testing.assert_array_equal(table[:, 1], [1, 3, 2, 4])
    np.testing.assert_array_equal(table[:, 0], 0)
    np.testing.assert_array_equal(table[1][table[3]], np.arange(5))
    np.testing.assert_array_equal(table[1][table[1]], table[2])


def test_another_order_of_actions_gives_another_table():
    order = np.array([4, 2, 0, 1, 3])
    table = quarters.permutations(YAW[order], MOVES[order])
    np.testing.assert_array_equal(table[1, 3], 4)  # W is action 3 here, A action 4
    np.testing.assert_array_equal(table[:, 2], 2)


@pytest.mark.parametrize("yaw", [[0.0, 0.5, 3.1, 1.6, -1.6], [0.0, 0.0, 0.05, 1.57, -1.57]])
def test_directions_that_are_not_quarters_apart_are_refused(yaw):
    with pytest.raises(ValueError, match="not those of quarter turns: leave `rotate` off"):
        quarters.permutations(np.array(yaw), MOVES)
