"""Foreground-aware bilinear upscaling: more surface points without ever blending in the background (UNICA 3.5)."""

from __future__ import annotations

import typing

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from avatarjax.posmap.atlas import Atlas
from avatarjax.posmap.neighbours import STEPS, around, neighbours

# The quarters of a texel, upper left to lower right, and the four texels, itself first, between which each lies.
_QUARTERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_CORNERS = np.array([[STEPS.index(s) for s in ((0, 0), (dy, 0), (0, dx), (dy, dx))] for dy, dx in _QUARTERS])


@typing.no_type_check
@flax.struct.dataclass
class Upscaler:
    """A fixed linear map from t texels to n = t factor^2 finer ones, those of one texel side by side.

    neighbours (t, 9) as `posmap.neighbours`; weights (t, 4, p, 4) of the four texels around each of the p fine texels
    in each quarter, with sum 1 over those that are foreground; rows, cols (n,) the place in the fine map of side
    `size`.
    """

    neighbours: Int[Array, "t 9"]
    weights: Float[Array, "t 4 p 4"]
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
    half = np.arange(factor // 2)
    inside, weights = [], []
    for dy, dx in _QUARTERS:
        i, j = (x.ravel() for x in np.meshgrid(half + (dy > 0) * half.size, half + (dx > 0) * half.size, indexing="ij"))
        # How far, in coarse texels, a fine texel's centre is from that of its coarse one, towards the quarter's corner.
        y, x = np.abs((i + 0.5) / factor - 0.5), np.abs((j + 0.5) / factor - 0.5)
        inside.append(np.stack([i, j], axis=1))
        weights.append(np.stack([(1 - y) * (1 - x), y * (1 - x), (1 - y) * x, y * x], axis=1))
    there = (around_each < len(around_each))[:, _CORNERS]
    share = np.stack(weights)[None] * there[:, :, None]
    inside = np.concatenate(inside)[None]
    rows = np.asarray(atlas.rows)[:, None] * factor + inside[..., 0]
    cols = np.asarray(atlas.cols)[:, None] * factor + inside[..., 1]
    return Upscaler(
        neighbours=jnp.asarray(around_each),
        weights=jnp.asarray(share / share.sum(-1, keepdims=True), jnp.float32),
        rows=jnp.asarray(rows.ravel(), jnp.int32),
        cols=jnp.asarray(cols.ravel(), jnp.int32),
        size=size,
    )


def upscale(upscaler: Upscaler, texels: Float[Array, "t d"]) -> Float[Array, "n d"]:
    """Values of the fine texels, those of one texel side by side: a fine map is `empty.at[rows, cols].set(values)`."""
    corners = around(upscaler.neighbours, texels)[:, _CORNERS]
    return jnp.einsum("tqpk,tqkd->tqpd", upscaler.weights, corners).reshape(-1, texels.shape[-1])
