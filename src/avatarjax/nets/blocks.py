"""Convolutional and attention blocks shared by the autoencoder, the denoiser and the point transformer.

Images are channels last, (b, h, w, c); token sequences are (b, n, c).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Bool, Float

GROUPS = 8


def sinusoidal_embedding(positions: Float[Array, "b"], features: int, period: float = 10_000.0) -> Float[Array, "b f"]:
    """Sines and cosines of scalar positions at geometric frequencies (Vaswani et al. 2017)."""
    frequencies = jnp.exp(-jnp.log(period) * jnp.arange(features // 2) / (features // 2))
    angles = positions[:, None] * frequencies[None]
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def octaves(x: Float[Array, "*b c"], count: int) -> Float[Array, "*b d"]:
    """Coordinates with their sines and cosines at `count` rising octaves, the first of period 2 (NeRF, Mildenhall et
    al. 2020): d = c (1 + 2 count)."""
    angles = [jnp.pi * 2.0**k * x for k in range(count)]
    return jnp.concatenate([x, *map(jnp.sin, angles), *map(jnp.cos, angles)], axis=-1)


def conv(inputs: int, outputs: int, *, rngs: nnx.Rngs, kernel: int = 3, stride: int = 1) -> nnx.Conv:
    """A two-dimensional convolution that keeps, or by its stride divides, the image size."""
    return nnx.Conv(inputs, outputs, (kernel, kernel), strides=stride, padding="SAME", rngs=rngs)


def double(x: Float[Array, "b h w c"]) -> Float[Array, "b h2 w2 c"]:
    """Nearest-neighbour upsampling by 2."""
    b, h, w, c = x.shape
    return jnp.broadcast_to(x[:, :, None, :, None], (b, h, 2, w, 2, c)).reshape(b, 2 * h, 2 * w, c)


class ResidualBlock(nnx.Module):
    """Norm, SiLU, conv, twice, with an optional per-sample embedding added in between (DDPM's residual block)."""

    def __init__(self, inputs: int, outputs: int, embedding: int = 0, *, rngs: nnx.Rngs):
        self.norm1 = nnx.GroupNorm(inputs, num_groups=GROUPS, rngs=rngs)
        self.conv1 = conv(inputs, outputs, rngs=rngs)
        self.norm2 = nnx.GroupNorm(outputs, num_groups=GROUPS, rngs=rngs)
        self.conv2 = conv(outputs, outputs, rngs=rngs)
        self.project = nnx.Linear(embedding, outputs, rngs=rngs) if embedding else None
        self.skip = conv(inputs, outputs, kernel=1, rngs=rngs) if inputs != outputs else None

    def __call__(
        self, x: Float[Array, "b h w c"], embedding: Float[Array, "b e"] | None = None
    ) -> Float[Array, "b h w d"]:
        h = self.conv1(jax.nn.silu(self.norm1(x)))
        if self.project is not None:
            h = h + self.project(jax.nn.silu(embedding))[:, None, None, :]
        h = self.conv2(jax.nn.silu(self.norm2(h)))
        return (x if self.skip is None else self.skip(x)) + h


class Attention(nnx.Module):
    """Multi-head attention from tokens to a context, or to themselves; a mask says which tokens of it count."""

    def __init__(self, features: int, heads: int, context: int | None = None, *, rngs: nnx.Rngs):
        self.heads = heads
        self.query = nnx.Linear(features, features, use_bias=False, rngs=rngs)
        self.key = nnx.Linear(context or features, features, use_bias=False, rngs=rngs)
        self.value = nnx.Linear(context or features, features, use_bias=False, rngs=rngs)
        self.out = nnx.Linear(features, features, rngs=rngs)

    def __call__(
        self,
        x: Float[Array, "b n c"],
        context: Float[Array, "b m d"] | None = None,
        mask: Bool[Array, "b m"] | None = None,
    ) -> Float[Array, "b n c"]:
        context = x if context is None else context
        q, k, v = (self._split(t) for t in (self.query(x), self.key(context), self.value(context)))
        mask = None if mask is None else mask[:, None, None, :]
        return self.out(jax.nn.dot_product_attention(q, k, v, mask=mask).reshape(x.shape))

    def _split(self, tokens: Float[Array, "b n c"]) -> Float[Array, "b n heads e"]:
        return tokens.reshape(*tokens.shape[:2], self.heads, -1)


class FeedForward(nnx.Module):
    """Two linear layers with a GELU gate (GEGLU, Shazeer 2020)."""

    def __init__(self, features: int, expansion: int = 2, *, rngs: nnx.Rngs):
        self.up = nnx.Linear(features, 2 * expansion * features, rngs=rngs)
        self.down = nnx.Linear(expansion * features, features, rngs=rngs)

    def __call__(self, x: Float[Array, "b n c"]) -> Float[Array, "b n c"]:
        value, gate = jnp.split(self.up(x), 2, axis=-1)
        return self.down(value * jax.nn.gelu(gate))
