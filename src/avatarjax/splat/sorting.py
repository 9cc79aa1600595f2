"""Stable sorts of small integers and of depths, in the form that is fast on each platform.

`lax.sort` takes about 75 ns an element on XLA's CPU backend. A counting sort written as a scan over rows of independent
columns, whose counters are updated in place, takes 5-10 ns. On other platforms its many small steps would each be a
kernel launch, and `lax.sort` is the fast way.
"""

from __future__ import annotations

import functools
import typing

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from avatarjax.splat import columns

_BLOCK = 32
_DEPTH_BITS, _DEPTH_COLUMNS = 12, 32
KEY_COLUMNS = 64
_SATURATED = 2**30


def exclusive_sum(counts: Int[Array, " n"]) -> Int[Array, " n"]:
    """Sum of all elements before each one, of non-negative integers, as int32.

    Exact up to 2^24; larger sums are rounded and end at 2^30, so that they never wrap around. Products with a triangle
    of ones are several times as fast as `jnp.cumsum` on CPU.
    """
    sums = jnp.minimum(_exclusive_sum(counts.astype(jnp.float32)), _SATURATED).astype(jnp.int32)
    return columns.materialize(sums)


def _exclusive_sum(x: Float[Array, " n"]) -> Float[Array, " n"]:
    n = x.shape[0]
    blocks = -(-n // _BLOCK)
    rows = jnp.pad(x, (0, blocks * _BLOCK - n)).reshape(blocks, _BLOCK)
    before = jnp.triu(jnp.ones((_BLOCK, _BLOCK), jnp.float32), 1)
    inside = jnp.dot(rows, before, precision="highest")
    if blocks == 1:
        return inside[0, :n]
    offsets = _exclusive_sum(inside[:, -1] + rows[:, -1])
    return (inside + offsets[:, None]).reshape(-1)[:n]


class Columns(typing.NamedTuple):
    """How a counting sort lays n elements out: one after another down `columns` columns of `rows` elements.

    Arrays in this layout are (rows, columns): a row, which is counted at once, lies together in memory.
    """

    n: int
    rows: int
    columns: int

    @classmethod
    def of(cls, n: int, columns: int) -> Columns:
        """About `columns` columns: more take larger tables of counters, fewer more rows. The number of rows is odd: the
        elements of a row come from as many parts of the cache."""
        rows = -(-n // columns) | 1
        return cls(n, rows, -(-n // rows))

    @property
    def elements(self) -> Int[Array, "r c"]:
        """Which element is where."""
        down = jnp.arange(self.rows, dtype=jnp.int32)[:, None]
        return down + self.rows * jnp.arange(self.columns, dtype=jnp.int32)[None]

    def lay(self, x: Int[Array, " n"], fill: int) -> Int[Array, "r c"]:
        """From elements in order to this layout, with `fill` behind the last."""
        return jnp.pad(x, (0, self.rows * self.columns - self.n), constant_values=fill).reshape(self.columns, -1).T

    def flat(self, x: Int[Array, "r c"]) -> Int[Array, " n"]:
        """The elements in order."""
        return x.T.reshape(-1)[: self.n]


def depth_order(depths: Float[Array, " n"], visible: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Indices of n positive depths from near to far, ties by index, the invisible last."""
    return lax.platform_dependent(depths, visible, cpu=_depth_order_counting, default=_depth_order_lax)


def group_by_key(
    keys: Int[Array, "r c"], values: Int[Array, "r c"], n_keys: int
) -> tuple[Int[Array, " m"], Int[Array, " k"], Int[Array, " k"]]:
    """Values, laid out as `Columns`, in stable order of their keys in 0..n_keys, and where the values of each key <
    n_keys start and end."""
    counting, comparing = (functools.partial(group, n_keys=n_keys) for group in (_group_counting, _group_lax))
    return lax.platform_dependent(keys, values, cpu=counting, default=comparing)


def _group_counting(
    keys: Int[Array, "r c"], values: Int[Array, "r c"], n_keys: int
) -> tuple[Int[Array, " m"], Int[Array, " k"], Int[Array, " k"]]:
    places, bounds = _places(keys, n_keys + 1)
    values = jnp.zeros(values.size, jnp.int32).at[places].set(values, unique_indices=True, mode="promise_in_bounds")
    return values, bounds[:-1], bounds[1:]


def _group_lax(
    keys: Int[Array, "r c"], values: Int[Array, "r c"], n_keys: int
) -> tuple[Int[Array, " m"], Int[Array, " k"], Int[Array, " k"]]:
    keys, values = (Columns(x.size, *x.shape).flat(x) for x in (keys, values))
    keys, values = lax.sort((keys, values), num_keys=1, is_stable=True)
    bounds = jnp.searchsorted(keys, jnp.arange(n_keys + 1, dtype=jnp.int32)).astype(jnp.int32)
    return values, bounds[:-1], bounds[1:]


def _depth_order_lax(depths: Float[Array, " n"], visible: Bool[Array, " n"]) -> Int[Array, " n"]:
    indices = jnp.arange(depths.shape[0], dtype=jnp.int32)
    return lax.sort((jnp.where(visible, depths, jnp.inf), indices), num_keys=1, is_stable=True)[1]


def _depth_order_counting(depths: Float[Array, " n"], visible: Bool[Array, " n"]) -> Int[Array, " n"]:
    # The bits of positive floats are ordered like the floats. Subtracting the smallest leaves few digits to sort.
    bits = lax.bitcast_convert_type(depths, jnp.int32)
    least = jnp.min(jnp.where(visible, bits, jnp.int32(2**31 - 1)))
    greatest = jnp.max(jnp.where(visible, bits, least))
    span = greatest - least + 1
    keys = jnp.where(visible, bits - least, span)
    passes = (32 - lax.clz(span) + _DEPTH_BITS - 1) // _DEPTH_BITS
    n = depths.shape[0]
    layout = Columns.of(n, _DEPTH_COLUMNS)

    def sort_digit(i, indices):
        digits = lax.shift_right_logical(columns.take(keys, indices), i * _DEPTH_BITS) & ((1 << _DEPTH_BITS) - 1)
        places, _ = _places(layout.lay(digits, (1 << _DEPTH_BITS) - 1), 1 << _DEPTH_BITS)
        return indices.at[layout.flat(places)].set(indices, unique_indices=True, mode="promise_in_bounds")

    return lax.fori_loop(jnp.int32(0), passes, sort_digit, jnp.arange(n, dtype=jnp.int32))


def _places(digits: Int[Array, "r c"], n_digits: int) -> tuple[Int[Array, "r c"], Int[Array, " d"]]:
    """Places of elements, laid out as `Columns`, in stable order of their digits in 0..n_digits-1, and the place where
    each digit starts.

    Each column has counters of its own, so that a row is counted at once. The scan is not unrolled, and reads a counter
    after it has written it: otherwise XLA on CPU copies the table of counters in every step, which costs a factor of 25
    to 1000.
    """
    n_columns = digits.shape[1]
    # Counters lie by digit, then by column, as places are handed out.
    slots = digits * n_columns + jnp.arange(n_columns, dtype=jnp.int32)[None]

    def count_row(counters, slots):
        counters = counters.at[slots].add(1, unique_indices=True, mode="promise_in_bounds")
        return counters, columns.take(counters, slots)

    counters, ranks = lax.scan(count_row, jnp.zeros(n_digits * n_columns, jnp.int32), slots)
    starts = exclusive_sum(counters)
    return columns.take(starts, slots) + ranks - 1, starts[::n_columns]
