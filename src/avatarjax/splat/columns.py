"""Rows to columns and back, in the way that keeps XLA on CPU from repeating work.

A `jnp.stack` of n-vectors, and the sum of padded columns that is the gradient of slicing, are fused with all that leads
to them, which is then computed again for every element of the result. Writing one column after another is not.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int, Num


def take(rows: Num[Array, "n ..."], places: Int[Array, "..."]) -> Num[Array, "..."]:
    """rows[places] for places that are known to exist: NumPy's rules for the others cost as much as the reading."""
    return rows.at[places].get(mode="promise_in_bounds")


def materialize(x: Num[Array, "n ..."]) -> Num[Array, "n ..."]:
    """x, computed once, and not again in all that reads it.

    `lax.optimization_barrier` is gone before XLA on CPU fuses operations; but what a scatter writes to has to exist.
    This one writes two elements behind the end, which is nothing.
    """
    return x.at[x.shape[0] + jnp.arange(2)].set(0, mode="drop", unique_indices=True)


@jax.custom_vjp
def join(columns: list[Num[Array, " n"]]) -> Num[Array, "n k"]:
    """The matrix of k columns."""
    rows = materialize(jnp.zeros((columns[0].shape[0], len(columns)), columns[0].dtype))
    for k, column in enumerate(columns):
        rows = lax.dynamic_update_slice(rows, column[:, None], (0, k))
    return materialize(rows)


@jax.custom_vjp
def split(rows: Num[Array, "n k"]) -> list[Num[Array, " n"]]:
    """The k columns of a matrix."""
    return [rows[:, k] for k in range(rows.shape[1])]


join.defvjp(lambda columns: (join(columns), None), lambda _, cotangent: (split(cotangent),))
split.defvjp(lambda rows: (split(rows), None), lambda _, cotangents: (join(cotangents),))
