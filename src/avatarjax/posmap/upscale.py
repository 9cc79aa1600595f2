"""Foreground-aware bilinear upscaling: more surface points without ever blending in the background (UNICA 3.5)."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.posmap.atlas import Atlas, windows


@typing.no_type_check
@flax.struct.dataclass
class Upscaler:
    """A fixed linear map from t texels to n = t factor^2 finer ones.

    neighbours (n, 4) texel ids and weights (n, 4) that sum to 1 over the foreground neighbours inside the same view;
    rows, cols (n,) the place in the fine map of side `size`.
    """

    neighbours: Int[Array, "n 4"]
    weights: Float[Array, "n 4"]
    rows: Int[Array, "n"]
    cols: Int[Array, "n"]
    size: int = flax.struct.field(pytree_node=False)


def build_upscaler(atlas: Atlas, size: int) -> Upscaler:
    """The upscaler from an atlas to maps of side `size`, a multiple of the atlas' side (ValueError otherwise).

    A fine texel is foreground where its nearest coarse texel is. Its value is the bilinear mean (half-pixel centres) of
    the up to four coarse neighbours that are foreground and in the same window: views that touch never mix.
    """
    if size % atlas.size:
        raise ValueError(f"upscaled side {size} must be a multiple of the map's side {atlas.size}")
    factor = size // atlas.size
    texel_id = np.full((atlas.size, atlas.size), -1)
    texel_id[np.asarray(atlas.rows), np.asarray(atlas.cols)] = np.arange(len(atlas.rows))

    parts = []
    for w in windows(atlas.size):
        block = texel_id[w.row : w.row + w.height, w.col : w.col + w.width]
        fine = np.repeat(np.repeat(block, factor, 0), factor, 1)
        i, j = np.nonzero(fine >= 0)
        y, x = (i + 0.5) / factor - 0.5, (j + 0.5) / factor - 0.5
        y0, x0 = np.floor(y).astype(int), np.floor(x).astype(int)
        ids, weights = [], []
        for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
            yy, xx = y0 + dy, x0 + dx
            inside = (yy >= 0) & (yy < w.height) & (xx >= 0) & (xx < w.width)
            neighbour = np.where(inside, block[np.clip(yy, 0, w.height - 1), np.clip(xx, 0, w.width - 1)], -1)
            bilinear = (1 - np.abs(y - yy)) * (1 - np.abs(x - xx))
            ids.append(np.maximum(neighbour, 0))
            weights.append(np.where(neighbour >= 0, bilinear, 0))
        parts.append((i + w.row * factor, j + w.col * factor, np.stack(ids, 1), np.stack(weights, 1)))

    rows, cols, ids, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((cols, rows))
    weights = weights / weights.sum(1, keepdims=True)
    return Upscaler(
        neighbours=jnp.asarray(ids[order], jnp.int32),
        weights=jnp.asarray(weights[order], jnp.float32),
        rows=jnp.asarray(rows[order], jnp.int32),
        cols=jnp.asarray(cols[order], jnp.int32),
        size=size,
    )


def upscale(upscaler: Upscaler, texels: Float[Array, "t d"]) -> Float[Array, "n d"]:
    """Values of the fine texels, row-major in the fine map."""
    return jnp.einsum("nk,nkd->nd", upscaler.weights, texels[upscaler.neighbours])
