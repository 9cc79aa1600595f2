"""The action-conditioned multi-frame denoising UNet (UNICA 3.4, C.1).

Four latent frames go in, three of them context and the last noisy; the noise of the last comes out. Every residual
block of the stages that downsample is followed by a transformer block: attention within a frame, cross attention to the
action embedding, and attention over the four frames at each place. With fewer context frames (UNICA Fig. 8) there are
so many fewer.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from avatarjax.nets.blocks import GROUPS, Attention, FeedForward, ResidualBlock, conv, double, sinusoidal_embedding


@dataclasses.dataclass(frozen=True)
class DenoiserConfig:
    """Sizes of the UNet; the defaults are the paper's. Every stage but the last downsamples by 2."""

    channels: tuple[int, ...] = (320, 640, 1280, 1280)
    residual_blocks: int = 2
    head_width: int = 64
    action_features: int = 768
    actions: int = 5
    latent_channels: int = 4
    context: int = 3  # frames before the noisy one

    def __post_init__(self):
        if not 1 <= self.context <= 3:
            raise ValueError(f"the model looks at 1, 2 or 3 context frames, not {self.context}")

    @property
    def frames(self) -> int:
        """Frames that go in: the context and the noisy one."""
        return self.context + 1

    @property
    def null_action(self) -> int:
        """The row of the action table that stands for no action, for classifier-free guidance."""
        return self.actions


class TransformerBlock(nnx.Module):
    """Spatial attention, cross attention to the action, temporal attention, each with its feed-forward layer."""

    def __init__(self, channels: int, config: DenoiserConfig, *, rngs: nnx.Rngs):
        heads = max(1, channels // config.head_width)
        self.frames = config.frames
        self.enter_norm = nnx.GroupNorm(channels, num_groups=GROUPS, rngs=rngs)
        self.enter = nnx.Linear(channels, channels, rngs=rngs)
        self.spatial_norm = nnx.LayerNorm(channels, rngs=rngs)
        self.spatial = Attention(channels, heads, rngs=rngs)
        self.cross_norm = nnx.LayerNorm(channels, rngs=rngs)
        self.cross = Attention(channels, heads, config.action_features, rngs=rngs)
        self.feed_norm = nnx.LayerNorm(channels, rngs=rngs)
        self.feed = FeedForward(channels, rngs=rngs)
        self.temporal_norm = nnx.LayerNorm(channels, rngs=rngs)
        self.temporal = Attention(channels, heads, rngs=rngs)
        self.temporal_feed_norm = nnx.LayerNorm(channels, rngs=rngs)
        self.temporal_feed = FeedForward(channels, rngs=rngs)
        self.leave = nnx.Linear(channels, channels, kernel_init=nnx.initializers.zeros, rngs=rngs)

    def __call__(self, x: Float[Array, "bf h w c"], action: Float[Array, "b 1 a"]) -> Float[Array, "bf h w c"]:
        frames, h, w, c = x.shape
        batch = frames // self.frames
        t = self.enter(self.enter_norm(x)).reshape(frames, h * w, c)
        t = t + self.spatial(self.spatial_norm(t))
        t = t + self.cross(self.cross_norm(t), jnp.repeat(action, self.frames, axis=0))
        t = t + self.feed(self.feed_norm(t))
        t = t.reshape(batch, self.frames, h * w, c).swapaxes(1, 2).reshape(batch * h * w, self.frames, c)
        t = t + self.temporal(self.temporal_norm(t))
        t = t + self.temporal_feed(self.temporal_feed_norm(t))
        t = t.reshape(batch, h * w, self.frames, c).swapaxes(1, 2).reshape(x.shape)
        return x + self.leave(t)


class Denoiser(nnx.Module):
    """epsilon_theta(Z, tau, e_k) of UNICA Eq. 5, with its table of action embeddings."""

    def __init__(self, config: DenoiserConfig, *, rngs: nnx.Rngs):
        self.config = config
        channels, first = config.channels, config.channels[0]
        embedding = 4 * first
        self.action_table = nnx.Embed(config.actions + 1, config.action_features, rngs=rngs)
        self.frame_table = nnx.Embed(config.frames, embedding, rngs=rngs)
        self.time1 = nnx.Linear(first, embedding, rngs=rngs)
        self.time2 = nnx.Linear(embedding, embedding, rngs=rngs)
        self.enter = conv(config.latent_channels, first, rngs=rngs)

        def block(inputs, outputs):
            return ResidualBlock(inputs, outputs, embedding, rngs=rngs)

        def attention(stage, width):
            # The coarsest stage has none in its residual blocks (C.1); the middle block has one.
            return TransformerBlock(width, config, rngs=rngs) if stage < len(channels) - 1 else None

        width, skips = first, [first]
        self.down, self.down_attention, self.shrink = nnx.List(), nnx.List(), nnx.List()
        for stage, outputs in enumerate(channels):
            for _ in range(config.residual_blocks):
                self.down.append(block(width, outputs))
                self.down_attention.append(attention(stage, outputs))
                width = outputs
                skips.append(width)
            if stage < len(channels) - 1:
                self.shrink.append(conv(width, width, stride=2, rngs=rngs))
                skips.append(width)
        self.middle1 = block(width, width)
        self.middle_attention = TransformerBlock(width, config, rngs=rngs)
        self.middle2 = block(width, width)
        self.up, self.up_attention, self.grow = nnx.List(), nnx.List(), nnx.List()
        for stage in reversed(range(len(channels))):
            for _ in range(config.residual_blocks + 1):
                self.up.append(block(width + skips.pop(), channels[stage]))
                self.up_attention.append(attention(stage, channels[stage]))
                width = channels[stage]
            if stage > 0:
                self.grow.append(conv(width, width, rngs=rngs))
        self.norm = nnx.GroupNorm(width, num_groups=GROUPS, rngs=rngs)
        self.leave = conv(width, config.latent_channels, rngs=rngs)

    def __call__(
        self, z: Float[Array, "b f h w l"], timestep: Int[Array, "b"], action: Int[Array, "b"]
    ) -> Float[Array, "b h w l"]:
        """The noise in the last of `config.frames` frames. `action` is an id, or `config.null_action` for none."""
        b, frames, h, w, latent = z.shape
        time = self.time1(sinusoidal_embedding(timestep.astype(jnp.float32), self.config.channels[0]))
        time = self.time2(jax.nn.silu(time))
        embedding = (time[:, None] + self.frame_table(jnp.arange(frames))[None]).reshape(b * frames, -1)
        action = self.action_table(action)[:, None]

        x = self.enter(z.reshape(b * frames, h, w, latent))
        skips, k = [x], 0
        for stage in range(len(self.config.channels)):
            for _ in range(self.config.residual_blocks):
                x = self._block(self.down[k], self.down_attention[k], x, embedding, action)
                skips.append(x)
                k += 1
            if stage < len(self.shrink):
                x = self.shrink[stage](x)
                skips.append(x)
        x = self._block(self.middle1, self.middle_attention, x, embedding, action)
        x = self.middle2(x, embedding)
        k = 0
        for stage in range(len(self.config.channels)):
            for _ in range(self.config.residual_blocks + 1):
                x = jnp.concatenate([x, skips.pop()], axis=-1)
                x = self._block(self.up[k], self.up_attention[k], x, embedding, action)
                k += 1
            if stage < len(self.grow):
                x = self.grow[stage](double(x))
        x = self.leave(jax.nn.silu(self.norm(x)))
        return x.reshape(b, frames, h, w, latent)[:, -1]

    @staticmethod
    def _block(residual, attention, x, embedding, action):
        x = residual(x, embedding)
        return x if attention is None else attention(x, action)
