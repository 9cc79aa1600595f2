"""A point transformer with static shapes: serialised patch attention in a U-shaped network (PTv3, Wu et al. 2024).

Points are sorted along space-filling curves, attention runs inside patches of consecutive points, and pooling joins
consecutive points of a curve. Against the released PTv3, pooling takes a fixed number of neighbours along the curve
instead of all points of a voxel, and the positional encoding is a depthwise convolution along the curve instead of a
sparse one over voxels: every shape is then known before the points are.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from avatarjax.nets import serialization
from avatarjax.nets.blocks import Attention


@dataclasses.dataclass(frozen=True)
class PointTransformerConfig:
    """Sizes of a point transformer; the defaults are UNICA's (C.1).

    One entry a stage in the encoder tuples, one less in the decoder's. `strides[i]` is the pooling between stages i and
    i + 1: it joins stride^2 points, as a stride of that many voxels does on a surface.
    """

    inputs: int = 14
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256, 512)
    encoder_depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    encoder_heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    strides: tuple[int, ...] = (1, 2, 2, 2)
    decoder_channels: tuple[int, ...] = (64, 64, 128, 256)
    decoder_depths: tuple[int, ...] = (2, 2, 2, 2)
    decoder_heads: tuple[int, ...] = (4, 4, 8, 16)
    patch: int = 1024
    grid: int = 192
    expansion: int = 4

    def __post_init__(self):
        stages = len(self.encoder_channels)
        encoder = (self.encoder_depths, self.encoder_heads)
        decoder = (self.decoder_channels, self.decoder_depths, self.decoder_heads, self.strides)
        if any(len(t) != stages for t in encoder) or any(len(t) != stages - 1 for t in decoder):
            raise ValueError(f"{stages} encoder stages need {stages} entries there and {stages - 1} elsewhere: {self}")


class CurveConvolution(nnx.Module):
    """A depthwise convolution along the order of a curve, zero beyond its ends.

    A sum of shifted copies: XLA's depthwise convolution is several times as slow on a CPU.
    """

    TAPS = 5

    def __init__(self, channels: int, *, rngs: nnx.Rngs):
        scale = nnx.initializers.variance_scaling(1.0, "fan_in", "normal", in_axis=0, out_axis=())
        self.kernel = nnx.Param(scale(rngs.params(), (self.TAPS, channels)))
        self.bias = nnx.Param(jnp.zeros(channels))

    def __call__(self, x: Float[Array, "n c"]) -> Float[Array, "n c"]:
        reach = self.TAPS // 2
        padded = jnp.pad(x, ((reach, reach), (0, 0)))
        taps = [self.kernel[...][None, k] * padded[k : k + len(x)] for k in range(self.TAPS)]
        return functools.reduce(jnp.add, taps, self.bias[...][None])


class Block(nnx.Module):
    """Curve convolution, patch attention and MLP, each with a residual connection, in the order of one curve."""

    def __init__(self, channels: int, heads: int, patch: int, expansion: int, *, rngs: nnx.Rngs):
        self.patch = patch
        self.position = CurveConvolution(channels, rngs=rngs)
        self.norm1 = nnx.LayerNorm(channels, rngs=rngs)
        self.attention = Attention(channels, heads, rngs=rngs)
        self.norm2 = nnx.LayerNorm(channels, rngs=rngs)
        self.up = nnx.Linear(channels, expansion * channels, rngs=rngs)
        self.down = nnx.Linear(expansion * channels, channels, rngs=rngs)

    def __call__(self, x: Float[Array, "n c"], order: Int[Array, "n"]) -> Float[Array, "n c"]:
        n, channels = x.shape
        patches = -(-n // self.patch)
        size = -(-n // patches)
        # A last, incomplete patch is moved back over points of the one before it, so that all patches are full.
        starts = jnp.minimum(jnp.arange(patches) * size, n - size)
        rows = (starts[:, None] + jnp.arange(size)[None]).reshape(-1)
        # Points that are in both of the last two patches take what the last one says: a gather, so on every device.
        place = jnp.arange(n)
        place = jnp.where(place < n - size, place, place + patches * size - n)

        x = x[order]
        x = x + self.position(x)
        attended = self.attention(self.norm1(x)[rows].reshape(patches, size, channels)).reshape(-1, channels)
        x = x + attended[place]
        x = x + self.down(jax.nn.gelu(self.up(self.norm2(x))))
        return jnp.zeros_like(x).at[order].set(x, unique_indices=True)


class Stage(nnx.Module):
    """Blocks that take the four curves in turn."""

    def __init__(self, channels: int, depth: int, heads: int, config: PointTransformerConfig, *, rngs: nnx.Rngs):
        self.blocks = nnx.List(
            [Block(channels, heads, config.patch, config.expansion, rngs=rngs) for _ in range(depth)]
        )

    def __call__(self, x: Float[Array, "n c"], orders: Int[Array, "4 n"]) -> Float[Array, "n c"]:
        for k, block in enumerate(self.blocks):
            x = block(x, orders[k % len(orders)])
        return x


class PointTransformer(nnx.Module):
    """Features (n, inputs) at points (n, 3) in [0, 1]^3 to features (n, decoder_channels[0])."""

    def __init__(self, config: PointTransformerConfig, *, rngs: nnx.Rngs):
        self.config = config
        enc, dec = config.encoder_channels, config.decoder_channels
        self.embed = nnx.Sequential(
            nnx.Linear(config.inputs, enc[0], rngs=rngs), jax.nn.gelu, nnx.Linear(enc[0], enc[0], rngs=rngs)
        )
        self.encoder = nnx.List(
            [
                Stage(c, d, h, config, rngs=rngs)
                for c, d, h in zip(enc, config.encoder_depths, config.encoder_heads, strict=True)
            ]
        )
        self.pool = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in itertools.pairwise(enc)])
        self.pool_norm = nnx.List([nnx.LayerNorm(c, rngs=rngs) for c in enc[1:]])
        self.decoder = nnx.List(
            [
                Stage(c, d, h, config, rngs=rngs)
                for c, d, h in zip(dec, config.decoder_depths, config.decoder_heads, strict=True)
            ]
        )
        coarser = (*dec[1:], enc[-1])
        self.unpool = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(coarser, dec, strict=True)])
        self.skip = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(enc[:-1], dec, strict=True)])

    def __call__(self, points: Float[Array, "n 3"], features: Float[Array, "n f"]) -> Float[Array, "n c"]:
        x = self.embed(features)
        levels, skips, parents = [self._orders(points)], [], []
        for s, stage in enumerate(self.encoder):
            x = stage(x, levels[-1])
            if s < len(self.pool):
                skips.append(x)
                points, x, parent = self._pool(s, points, x, levels[-1][0])
                parents.append(parent)
                levels.append(self._orders(points))
        for s in reversed(range(len(self.decoder))):
            x = self.unpool[s](x)[parents[s]] + self.skip[s](skips[s])
            x = self.decoder[s](jax.nn.gelu(x), levels[s])
        return x

    def _orders(self, points: Float[Array, "n 3"]) -> Int[Array, "4 n"]:
        voxel = serialization.voxels(points, self.config.grid)
        bits = max(1, (self.config.grid - 1).bit_length())
        keys = [serialization.codes(voxel, bits, curve) for curve in serialization.CURVES]
        return jnp.stack([jnp.argsort(k) for k in keys])

    def _pool(self, stage: int, points: Float[Array, "n 3"], x: Float[Array, "n c"], order: Int[Array, "n"]):
        """Pooled points (m, 3), their features (m, d), and each point's parent (n,)."""
        group = self.config.strides[stage] ** 2
        n = len(order)
        pooled = -(-n // group)
        # Repeating the last point changes no maximum and moves only the last group's mean.
        filled = order[jnp.minimum(jnp.arange(pooled * group), n - 1)]
        projected = self.pool[stage](x)[filled].reshape(pooled, group, -1)
        parent = jnp.zeros(n, jnp.int32).at[order].set(jnp.arange(n, dtype=jnp.int32) // group)
        features = jax.nn.gelu(self.pool_norm[stage](projected.max(1)))
        return points[filled].reshape(pooled, group, 3).mean(1), features, parent
