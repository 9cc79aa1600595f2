"""Which texels lie beside each other on the surface: 3x3 neighbourhoods that never leave their view."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.posmap.atlas import Atlas, windows

# Steps (row, column) to the neighbours, in reading order; the texel itself is the fifth.
STEPS = tuple((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1))
SELF = STEPS.index((0, 0))


def neighbours(atlas: Atlas) -> Int[np.ndarray, "t 9"]:
    """Texel ids of the neighbours of each texel in the order of STEPS; t, one past the last, where there is none.

    None means background or another view: views that touch in the map do not touch on the surface.
    """
    rows, cols = np.asarray(atlas.rows), np.asarray(atlas.cols)
    count = len(rows)
    # A margin of one texel around the map spares the test for its border.
    ids = np.full((atlas.size + 2, atlas.size + 2), count)
    ids[rows + 1, cols + 1] = np.arange(count)
    view = np.full((atlas.size + 2, atlas.size + 2), -1)
    for k, w in enumerate(windows(atlas.size)):
        view[w.row + 1 : w.row + 1 + w.height, w.col + 1 : w.col + 1 + w.width] = k
    found = []
    for dy, dx in STEPS:
        place = rows + 1 + dy, cols + 1 + dx
        found.append(np.where(view[place] == view[rows + 1, cols + 1], ids[place], count))
    return np.stack(found, axis=1).astype(np.int32)


def around(neighbours: Int[Array, "t k"], values: Float[Array, "t d"]) -> Float[Array, "t k d"]:
    """The values of each texel's neighbours, zero where there is none."""
    return _padded(values)[neighbours]


@jax.custom_vjp
def convolve(
    neighbours: Int[Array, "t 9"], values: Float[Array, "t c"], kernel: Float[Array, "9 c d"]
) -> Float[Array, "t d"]:
    """A 3x3 convolution on the surface: each texel's sum of its neighbours' values times the kernel of the step there.

    One product a step: a single one of all gathered values takes XLA's CPU backend four times as long. Neighbours are
    mutual, so gradients are gathered the same way back.
    """
    there = _padded(values)
    return functools.reduce(jnp.add, [there[neighbours[:, k]] @ kernel[k] for k in range(len(STEPS))])


def _forward(neighbours, values, kernel):
    return convolve(neighbours, values, kernel), (neighbours, values, kernel)


def _backward(saved, gradient):
    neighbours, values, kernel = saved
    there = _padded(gradient)
    # The k-th step from the end undoes the k-th from the start.
    back = [there[neighbours[:, len(STEPS) - 1 - k]] for k in range(len(STEPS))]
    to_values = functools.reduce(jnp.add, [b @ k.T for b, k in zip(back, kernel, strict=True)])
    return None, to_values, jnp.stack([values.T @ b for b in back])


convolve.defvjp(_forward, _backward)


def _padded(values: Float[Array, "t d"]) -> Float[Array, "u d"]:
    """The values and a last row of zeros, for neighbours that are not there."""
    return jnp.concatenate([values, jnp.zeros_like(values[:1])])
