"""Rows to columns and back, in the way that keeps XLA on CPU from repeating work.

A `jnp.stack` of n-vectors, and the sum of padded columns that is the gradient of slicing, are fused with all that leads
to them, which is then computed again for every element of the result. Writing one column after another is not.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def join(columns: list[Float[Array, " n"]]) -> Float[Array, "n k"]:
    """The matrix of k columns."""
    rows = jnp.zeros((columns[0].shape[0], len(columns)), columns[0].dtype)
    for k, column in enumerate(columns):
        rows = rows.at[:, k].set(column)
    return rows


@jax.custom_vjp
def split(rows: Float[Array, "n k"]) -> list[Float[Array, " n"]]:
    """The k columns of a matrix."""
    return [rows[:, k] for k in range(rows.shape[1])]


split.defvjp(lambda rows: (split(rows), None), lambda _, cotangents: (join(cotangents),))
