"""The sorts of both kinds of platform against NumPy."""

import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.splat import sorting


@pytest.mark.parametrize("n", [1, 127, 128, 129, 20_000])
def test_exclusive_sum_is_exact(n):
    counts = np.random.default_rng(n).integers(0, 500, n).astype(np.int32)
    np.testing.assert_array_equal(sorting.exclusive_sum(jnp.asarray(counts)), np.cumsum(counts) - counts)


def test_exclusive_sum_saturates_and_never_wraps_around():
    total = np.asarray(sorting.exclusive_sum(jnp.full(10_000, 1_000_000, jnp.int32)))
    assert np.all(np.diff(total) >= 0) and total[-1] == 2**30


@pytest.mark.parametrize("sort", [sorting.depth_order, sorting._depth_order_lax, sorting._depth_order_counting])
@pytest.mark.parametrize("span", [0.0, 1e-3, 1e4])
def test_depth_order_is_stable_with_the_invisible_last(sort, span):
    rng = np.random.default_rng(0)
    depths = (0.5 + span * rng.integers(0, 300, 1000)).astype(np.float32)
    visible = rng.random(1000) < 0.7
    expected = np.argsort(np.where(visible, depths, np.inf), kind="stable")
    np.testing.assert_array_equal(sort(jnp.asarray(depths), jnp.asarray(visible)), expected)


def test_depth_order_of_the_invisible_is_a_permutation():
    order = sorting.depth_order(jnp.ones(50), jnp.zeros(50, bool))
    np.testing.assert_array_equal(np.sort(order), np.arange(50))


@pytest.mark.parametrize("n", [1, 2, 31, 32, 33, 1000])
def test_layout_in_columns_and_back_is_the_identity(n):
    layout = sorting.Columns.of(n, 32)
    x = jnp.arange(n, dtype=jnp.int32)
    laid = layout.lay(x, -1)
    np.testing.assert_array_equal(layout.flat(laid), x)
    np.testing.assert_array_equal(jnp.where(laid < 0, layout.elements, laid), layout.elements)


@pytest.mark.parametrize(
    "group", [sorting.group_by_key, sorting._group_counting, sorting._group_lax], ids=["here", "counting", "lax"]
)
def test_values_are_grouped_by_key_in_stable_order(group):
    keys = np.random.default_rng(0).integers(0, 8, 500).astype(np.int32)
    layout = sorting.Columns.of(500, 8)
    laid = layout.lay(jnp.asarray(keys), 7)
    values, starts, ends = group(laid, layout.elements, 7)
    for key in range(7):
        np.testing.assert_array_equal(values[starts[key] : ends[key]], np.flatnonzero(keys == key))
