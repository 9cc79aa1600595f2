"""Point Transformer V3 with static shapes: serialised patch attention in a U-shaped network (PTv3, Wu et al. 2024).

Points are sorted along space-filling curves, attention runs inside patches of consecutive points, pooling joins the
points of a voxel, and a sparse convolution over occupied voxels is the positional encoding. Normalisation is LayerNorm
wherever the released PTv3 has BatchNorm: there are no running statistics.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float, Int, Key

from avatarjax.nets import levels as resolutions
from avatarjax.nets import submanifold
from avatarjax.nets.blocks import Attention
from avatarjax.nets.levels import Level


@dataclasses.dataclass(frozen=True)
class PointTransformerConfig:
    """Sizes of a point transformer; the defaults are UNICA's (C.1) or, tagged code, the released PTv3's.

    One entry a stage in the encoder tuples, one less in the decoder's. `strides[i]`, a power of two, is how many times
    as wide the voxels of stage i + 1 are; 1 merges the points of a voxel. A stage after the first has room for `fill`
    voxels for each voxel of a face of its grid; `overflow` says where that was too few.
    """

    inputs: int = 14
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256, 512)
    encoder_depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    encoder_heads: tuple[int, ...] = (2, 4, 8, 16, 32)  # code
    strides: tuple[int, ...] = (1, 2, 2, 2)
    decoder_channels: tuple[int, ...] = (64, 64, 128, 256)
    decoder_depths: tuple[int, ...] = (2, 2, 2, 2)
    decoder_heads: tuple[int, ...] = (4, 4, 8, 16)  # code
    patch: int = 1024
    grid: int = 192  # code
    expansion: int = 4  # code
    shuffle: bool = True  # code: the curves in another order on every level, in training
    recompute: bool = True  # ours: gradients compute attention weights again instead of keeping them
    fill: float = 3.0  # ours; the paper's 450,000 points take up to 2.0

    def __post_init__(self):
        stages = len(self.encoder_channels)
        encoder = (self.encoder_depths, self.encoder_heads)
        decoder = (self.decoder_channels, self.decoder_depths, self.decoder_heads, self.strides)
        if any(len(t) != stages for t in encoder) or any(len(t) != stages - 1 for t in decoder):
            raise ValueError(f"{stages} encoder stages need {stages} entries there and {stages - 1} elsewhere: {self}")
        if any(stride < 1 or stride & (stride - 1) for stride in self.strides):
            raise ValueError(f"strides must be powers of two, not {self.strides}")
        if not 1 < self.grid <= 1024:
            raise ValueError(f"a grid has 2 to 1024 voxels an edge, whose codes fit into 32 bits, not {self.grid}")


class VoxelConvolution(nnx.Module):
    """A 3x3x3 convolution over occupied voxels, which have the mean features of their points."""

    def __init__(self, channels: int, *, rngs: nnx.Rngs):
        scale = nnx.initializers.lecun_normal(in_axis=(0, 1))
        self.kernel = nnx.Param(scale(rngs.params(), (len(submanifold.STEPS), channels, channels)))
        self.bias = nnx.Param(jnp.zeros(channels))

    def __call__(self, x: Float[Array, "n c"], level: Level) -> Float[Array, "m c"]:
        if level.voxel is not None:
            counted = jnp.concatenate([x, jnp.ones_like(x[:, :1])], axis=1)
            total = jax.ops.segment_sum(counted, level.voxel, len(level.neighbours), indices_are_sorted=True)
            x = total[:, :-1] / jnp.maximum(total[:, -1:], 1.0)
        return submanifold.convolve(x, self.kernel[...], level.neighbours, level.voxels) + self.bias[...][None]


class PatchAttention(nnx.Module):
    """Attention among each patch of consecutive points on a curve.

    A last, incomplete patch borrows the end of the one before it, so that all are full (PTv3 4.2).
    """

    def __init__(self, channels: int, heads: int, patch: int, recompute: bool = False, *, rngs: nnx.Rngs):
        self.patch, self.recompute = patch, recompute
        self.attention = Attention(channels, heads, rngs=rngs)

    def __call__(
        self, x: Float[Array, "n c"], count: Int[Array, ""], order: Int[Array, "n"], rank: Int[Array, "n"]
    ) -> Float[Array, "n c"]:
        n, channels = x.shape
        size = min(self.patch, n)
        patches = -(-n // size)
        starts = jnp.minimum(jnp.arange(patches) * size, jnp.maximum(count - size, 0))
        rows = starts[:, None] + jnp.arange(size)[None]
        # Only where all points together do not fill a patch is there padding in it.
        attend = jax.checkpoint(self._attend) if self.recompute else self._attend
        attended = attend(x[order[rows]], rows < count)
        # A point in two patches takes what the one says that is its own.
        own = rank // size
        return attended.reshape(-1, channels)[own * size + rank - starts[own]]

    def _attend(self, patches: Float[Array, "p s c"], known: Bool[Array, "p s"]) -> Float[Array, "p s c"]:
        return self.attention(patches, mask=known)


class Block(nnx.Module):
    """Sparse convolution, patch attention and MLP, each with a residual connection."""

    def __init__(self, channels: int, heads: int, config: PointTransformerConfig, *, rngs: nnx.Rngs):
        self.position = VoxelConvolution(channels, rngs=rngs)
        self.position_out = nnx.Linear(channels, channels, rngs=rngs)
        self.position_norm = nnx.LayerNorm(channels, rngs=rngs)
        self.norm1 = nnx.LayerNorm(channels, rngs=rngs)
        self.attention = PatchAttention(channels, heads, config.patch, config.recompute, rngs=rngs)
        self.norm2 = nnx.LayerNorm(channels, rngs=rngs)
        self.up = nnx.Linear(channels, config.expansion * channels, rngs=rngs)
        self.down = nnx.Linear(config.expansion * channels, channels, rngs=rngs)

    def __call__(self, x: Float[Array, "n c"], level: Level, curve: int) -> Float[Array, "n c"]:
        position = self.position_norm(self.position_out(self.position(x, level)))
        x = x + (position if level.voxel is None else _rows(position, level.voxel))
        x = x + self.attention(self.norm1(x), level.count, level.orders[curve], level.ranks[curve])
        return x + self.down(jax.nn.gelu(self.up(self.norm2(x))))


class Stage(nnx.Module):
    """Blocks that take the four curves in turn."""

    def __init__(self, channels: int, depth: int, heads: int, config: PointTransformerConfig, *, rngs: nnx.Rngs):
        self.blocks = nnx.List([Block(channels, heads, config, rngs=rngs) for _ in range(depth)])

    def __call__(self, x: Float[Array, "n c"], level: Level) -> Float[Array, "n c"]:
        for k, block in enumerate(self.blocks):
            x = block(x, level, k % len(level.orders))
        return x


class Projection(nnx.Module):
    """Linear, LayerNorm, GELU; from one level to a coarser one, with the maximum over each cluster after the first."""

    def __init__(self, inputs: int, outputs: int, *, rngs: nnx.Rngs):
        self.linear = nnx.Linear(inputs, outputs, rngs=rngs)
        self.norm = nnx.LayerNorm(outputs, rngs=rngs)

    def __call__(self, x: Float[Array, "n c"], level: Level | None = None, coarser: Level | None = None):
        x = self.linear(x)
        if level is not None and coarser is not None:
            room = coarser.orders.shape[1]
            x = jax.ops.segment_max(x, level.parent, room, indices_are_sorted=True)
            # A place without a cluster has no maximum.
            x = jnp.where((jnp.arange(room) < coarser.count)[:, None], x, 0.0)
        return jax.nn.gelu(self.norm(x))


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
        self.pool = nnx.List([Projection(a, b, rngs=rngs) for a, b in itertools.pairwise(enc)])
        self.decoder = nnx.List(
            [
                Stage(c, d, h, config, rngs=rngs)
                for c, d, h in zip(dec, config.decoder_depths, config.decoder_heads, strict=True)
            ]
        )
        coarser = (*dec[1:], enc[-1])
        self.unpool = nnx.List([Projection(a, b, rngs=rngs) for a, b in zip(coarser, dec, strict=True)])
        self.skip = nnx.List([Projection(a, b, rngs=rngs) for a, b in zip(enc[:-1], dec, strict=True)])

    def __call__(
        self, points: Float[Array, "n 3"], features: Float[Array, "n f"], key: Key[Array, ""] | None = None
    ) -> Float[Array, "n c"]:
        """With a key, each level has the curves in an order of its own (PTv3 4.2); without, in that of CURVES."""
        along_z, levels = resolutions.build(points, self.config.grid, self.config.strides, self.config.fill)
        if key is not None:
            levels = [_shuffled(level, k) for level, k in zip(levels, jax.random.split(key, len(levels)), strict=True)]
        x = self.embed(features[along_z])
        skips = []
        for s, stage in enumerate(self.encoder):
            x = stage(x, levels[s])
            if s < len(self.pool):
                skips.append(x)
                x = self.pool[s](x, levels[s], levels[s + 1])
        for s in reversed(range(len(self.decoder))):
            x = _rows(self.unpool[s](x), levels[s].parent) + self.skip[s](skips[s])
            x = self.decoder[s](x, levels[s])
        return jnp.zeros_like(x).at[along_z].set(x, unique_indices=True)


def overflow(config: PointTransformerConfig, points: Float[Array, "n 3"]) -> Int[Array, ""]:
    """How many voxels of points in [0, 1]^3 find no room on their level; 0, or `config.fill` is too small.

    Points there miss the positional encoding, or what their stage would learn from the coarser ones.
    """
    return resolutions.dropped(points, config.grid, config.strides, config.fill)


def _rows(x: Float[Array, "m c"], row: Int[Array, "n"]) -> Float[Array, "n c"]:
    """Rows of x; zeros past its end."""
    return x.at[row].get(mode="fill", fill_value=0)


def _shuffled(level: Level, key: Key[Array, ""]) -> Level:
    curves = jax.random.permutation(key, len(level.orders))
    return level._replace(orders=level.orders[curves], ranks=level.ranks[curves])
