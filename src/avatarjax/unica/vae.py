"""The variational autoencoder of position maps (UNICA C.1): the latent space in which the denoiser works."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Key

from avatarjax.nets.blocks import GROUPS, Attention, ResidualBlock, conv, double


@dataclasses.dataclass(frozen=True)
class VAEConfig:
    """Sizes; every stage but the last halves the map, so three stages downsample by 4 and four by 8 (the paper's).

    `positions` (ours) is the side of the map if each of its places gets a learned embedding in encoder and decoder: a
    place is always the same spot of the body, which a convolution cannot know. 0 is the paper's network.
    """

    channels: tuple[int, ...] = (128, 256, 512, 512)
    residual_blocks: int = 2
    latent_channels: int = 4
    data_channels: int = 3
    positions: int = 0
    decoder_blocks: int | None = None  # a stage of the decoder; None: as many as `residual_blocks`; code: 3

    @property
    def downsampling(self) -> int:
        """Map side divided by latent side."""
        return 2 ** (len(self.channels) - 1)

    @property
    def blocks_up(self) -> int:
        """Residual blocks a stage of the decoder."""
        return self.residual_blocks if self.decoder_blocks is None else self.decoder_blocks


class Middle(nnx.Module):
    """Residual block, spatial self-attention, residual block at the coarsest resolution."""

    def __init__(self, channels: int, *, rngs: nnx.Rngs):
        self.block1 = ResidualBlock(channels, channels, rngs=rngs)
        self.norm = nnx.GroupNorm(channels, num_groups=GROUPS, rngs=rngs)
        self.attention = Attention(channels, 1, rngs=rngs)
        self.block2 = ResidualBlock(channels, channels, rngs=rngs)

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        x = self.block1(x)
        tokens = self.norm(x).reshape(x.shape[0], -1, x.shape[-1])
        return self.block2(x + self.attention(tokens).reshape(x.shape))


class Places(nnx.Module):
    """A learned gain and shift a place of a (side, side) map, neutral at first."""

    def __init__(self, side: int, channels: int):
        self.gain = nnx.Param(jnp.ones((side, side, channels)))
        self.shift = nnx.Param(jnp.zeros((side, side, channels)))

    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        return x * self.gain[...][None] + self.shift[...][None]


class VAE(nnx.Module):
    """Encoder to the mean and log-variance of a Gaussian latent, and decoder back to maps."""

    def __init__(self, config: VAEConfig, *, rngs: nnx.Rngs):
        self.config = config
        first, last = config.channels[0], config.channels[-1]
        self.enter = conv(config.data_channels, first, rngs=rngs)
        self.places = nnx.Dict()
        if config.positions:
            coarse = config.positions // config.downsampling
            self.places["encoder_fine"] = Places(config.positions, first)
            self.places["encoder_coarse"] = Places(coarse, last)
            self.places["decoder_coarse"] = Places(coarse, last)
            self.places["decoder_fine"] = Places(config.positions, first)
        self.down, self.shrink = nnx.List(), nnx.List()
        width = first
        for stage, channels in enumerate(config.channels):
            for _ in range(config.residual_blocks):
                self.down.append(ResidualBlock(width, channels, rngs=rngs))
                width = channels
            if stage < len(config.channels) - 1:
                self.shrink.append(conv(width, width, stride=2, rngs=rngs))
        self.encoder_middle = Middle(last, rngs=rngs)
        self.encoder_norm = nnx.GroupNorm(last, num_groups=GROUPS, rngs=rngs)
        self.to_moments = conv(last, 2 * config.latent_channels, rngs=rngs)

        self.from_latent = conv(config.latent_channels, last, rngs=rngs)
        self.decoder_middle = Middle(last, rngs=rngs)
        self.up, self.grow = nnx.List(), nnx.List()
        for stage, channels in enumerate(reversed(config.channels)):
            for _ in range(config.blocks_up):
                self.up.append(ResidualBlock(width, channels, rngs=rngs))
                width = channels
            if stage < len(config.channels) - 1:
                self.grow.append(conv(width, width, rngs=rngs))
        self.decoder_norm = nnx.GroupNorm(first, num_groups=GROUPS, rngs=rngs)
        self.leave = conv(first, config.data_channels, rngs=rngs)

    def encode(self, x: Float[Array, "b h w c"]) -> tuple[Float[Array, "b u v l"], Float[Array, "b u v l"]]:
        """Mean and log-variance of the latent of maps in [-1, 1]."""
        x = self._place("encoder_fine", self.enter(x))
        for stage in range(len(self.config.channels)):
            for k in range(self.config.residual_blocks):
                x = self.down[stage * self.config.residual_blocks + k](x)
            if stage < len(self.shrink):
                x = self.shrink[stage](x)
        x = self.encoder_middle(self._place("encoder_coarse", x))
        x = self.to_moments(jax.nn.silu(self.encoder_norm(x)))
        mean, log_variance = jnp.split(x, 2, axis=-1)
        return mean, jnp.clip(log_variance, -30.0, 20.0)

    def decode(self, z: Float[Array, "b u v l"]) -> Float[Array, "b h w c"]:
        """Maps in [-1, 1] (not clipped) of latents."""
        x = self.decoder_middle(self._place("decoder_coarse", self.from_latent(z)))
        for stage in range(len(self.config.channels)):
            for k in range(self.config.blocks_up):
                x = self.up[stage * self.config.blocks_up + k](x)
            if stage < len(self.grow):
                x = self.grow[stage](double(x))
        return self.leave(jax.nn.silu(self.decoder_norm(self._place("decoder_fine", x))))

    def _place(self, name: str, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        return self.places[name](x) if name in self.places else x


def sample_latent(
    mean: Float[Array, "*b"], log_variance: Float[Array, "*b"], key: Key[Array, ""]
) -> Float[Array, "*b"]:
    """A latent by the reparameterisation trick (Kingma and Welling 2014)."""
    return mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)


def kl_divergence(mean: Float[Array, "b *d"], log_variance: Float[Array, "b *d"]) -> Float[Array, ""]:
    """Mean over latent entries of KL(N(mean, variance) || N(0, 1)), in nats."""
    return 0.5 * jnp.mean(mean**2 + jnp.exp(log_variance) - 1 - log_variance)
