"""Foreground-aware bilinear upscaling: more surface points without ever blending in the background (UNICA 3.5)."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.posmap.atlas import Atlas
from avatarjax.posmap.neighbours import STEPS, around, neighbours


@typing.no_type_check
@flax.struct.dataclass
class Upscaler:
    """A fixed linear map from t texels to n = t factor^2 finer ones, those of one texel side by side.

    neighbours (t, 9) as `posmap.neighbours`; weights (t, p, 9) of them for each of the p = factor^2 fine texels, with
    sum 1, of which at most four are not 0; rows, cols (n,) the place in the fine map of side `size`.
    """

    neighbours: Int[Array, "t 9"]
    weights: Float[Array, "t p 9"]
    rows: Int[Array, "n"]
    cols: Int[Array, "n"]
    size: int = flax.struct.field(pytree_node=False)


def build_upscaler(atlas: Atlas, size: int) -> Upscaler:
    """The upscaler from an atlas to maps of side `size`, an even multiple of the atlas' side (ValueError otherwise).

    A fine texel is foreground where its coarse texel is. Its value is the bilinear mean (half-pixel centres) of the up
    to four coarse neighbours that are foreground and in the same window: views that touch never mix.
    """
    factor = size // atlas.size
    if size % atlas.size or factor % 2:
        raise ValueError(f"upscaled side {size} must be an even multiple of the map's side {atlas.size}")
    around_each = neighbours(atlas)
    # Quarter by quarter: the order in which files have what belongs to fine texels.
    below, right, row, col = np.indices((2, 2, factor // 2, factor // 2)).reshape(4, -1)
    inside = np.stack([below * (factor // 2) + row, right * (factor // 2) + col], axis=1)
    # From neighbours' centres to a fine texel's, of which the share falls linearly to 0 at a texel's distance.
    away = np.abs(((inside + 0.5) / factor - 0.5)[:, None] - np.array(STEPS)[None])
    weights = np.maximum(1 - away, 0).prod(axis=-1)
    share = weights[None] * (around_each < len(around_each))[:, None]
    rows = np.asarray(atlas.rows)[:, None] * factor + inside[None, :, 0]
    cols = np.asarray(atlas.cols)[:, None] * factor + inside[None, :, 1]
    return Upscaler(
        neighbours=jnp.asarray(around_each),
        weights=jnp.asarray(share / share.sum(-1, keepdims=True), jnp.float32),
        rows=jnp.asarray(rows.ravel(), jnp.int32),
        cols=jnp.asarray(cols.ravel(), jnp.int32),
        size=size,
    )


def upscale(upscaler: Upscaler, texels: Float[Array, "t d"]) -> Float[Array, "n d"]:
    """Values of the fine texels, those of one texel side by side: a fine map is `empty.at[rows, cols].set(values)`."""
    fine = jnp.einsum("tpk,tkd->tpd", upscaler.weights, around(upscaler.neighbours, texels))
    return fine.reshape(-1, texels.shape[-1])
