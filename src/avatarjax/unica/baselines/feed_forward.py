"""The feed-forward pipeline that UNICA D.1 compares diffusion with: a VQ-VAE and a spatial-temporal transformer.

After Genie (Bruce et al. 2024): three position maps are encoded into a codebook, a fourth frame of zeros is appended,
the action's embedding is added to the tokens of all four, attention within frames and over time updates them, and those
of the fourth are aligned to the codebook and decoded.

The paper gives neither sizes nor losses. Ours: the VQ-VAE is the run's autoencoder without its sampling; the
transformer regresses the code vectors of the fourth frame by mean squared error, so that a code next to the right one
costs little, and no gradient passes the alignment, which is to the nearest entry. There is no noise anywhere: a context
and a key have one next frame.
"""

from __future__ import annotations

import dataclasses
import typing

import flax.struct
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from avatarjax.nets import functional
from avatarjax.nets.blocks import Attention, FeedForward
from avatarjax.nets.functional import Params, bind
from avatarjax.posmap import Atlas
from avatarjax.unica import latent
from avatarjax.unica.baselines import vq
from avatarjax.unica.config import UnicaConfig
from avatarjax.unica.denoiser import Denoiser
from avatarjax.unica.vae import VAE, VAEConfig

CODE = 32  # width of a code vector; Genie's, as is the number of codes
EXPANSION = 4  # of a block's feed-forward layer


@dataclasses.dataclass(frozen=True)
class FeedForwardConfig:
    """Sizes: of the autoencoder, of its map of codes (`side` by `side`), and of the transformer."""

    vae: VAEConfig
    side: int
    width: int
    depth: int
    heads: int
    actions: int = 5
    codes: int = 1024
    commitment: float = 0.25  # van den Oord et al.'s


def sized(config: UnicaConfig) -> FeedForwardConfig:
    """Sizes for a run: its autoencoder with wider latents, and a transformer as wide as the UNet where that is coarsest
    and so deep that it has as many parameters."""
    unet, vae = config.latent.denoiser, config.latent.vae
    width = unet.channels[-1]
    block = (8 + 3 * EXPANSION) * width**2
    return FeedForwardConfig(
        vae=dataclasses.replace(vae, latent_channels=CODE),
        side=config.size // vae.downsampling,
        width=width,
        depth=max(1, round(functional.count(functional.shapes(Denoiser, unet)) / block)),
        heads=max(1, width // unet.head_width),
        actions=unet.actions,
    )


class Block(nnx.Module):
    """Attention within each frame, attention over the frames at each place, one feed-forward layer after both."""

    def __init__(self, config: FeedForwardConfig, *, rngs: nnx.Rngs):
        width = config.width
        self.spatial_norm = nnx.LayerNorm(width, rngs=rngs)
        self.spatial = Attention(width, config.heads, rngs=rngs)
        self.temporal_norm = nnx.LayerNorm(width, rngs=rngs)
        self.temporal = Attention(width, config.heads, rngs=rngs)
        self.feed_norm = nnx.LayerNorm(width, rngs=rngs)
        self.feed = FeedForward(width, EXPANSION, rngs=rngs)

    def __call__(self, x: Float[Array, "b f n c"]) -> Float[Array, "b f n c"]:
        b, f, n, c = x.shape
        x = x.reshape(b * f, n, c)
        x = x + self.spatial(self.spatial_norm(x))
        x = x.reshape(b, f, n, c).swapaxes(1, 2).reshape(b * n, f, c)
        x = x + self.temporal(self.temporal_norm(x))
        x = x + self.feed(self.feed_norm(x))
        return x.reshape(b, n, f, c).swapaxes(1, 2)


class Transformer(nnx.Module):
    """The fourth frame's tokens from those of three and an action."""

    def __init__(self, config: FeedForwardConfig, *, rngs: nnx.Rngs):
        width, code = config.width, config.vae.latent_channels
        self.enter = nnx.Linear(code, width, rngs=rngs)
        self.place_table = nnx.Embed(config.side**2, width, rngs=rngs)
        self.frame_table = nnx.Embed(latent.CONTEXT + 1, width, rngs=rngs)
        self.action_table = nnx.Embed(config.actions, width, rngs=rngs)
        self.blocks = nnx.List([Block(config, rngs=rngs) for _ in range(config.depth)])
        self.norm = nnx.LayerNorm(width, rngs=rngs)
        self.leave = nnx.Linear(width, code, rngs=rngs)

    def __call__(self, context: Float[Array, "b 3 u v l"], action: Int[Array, "b"]) -> Float[Array, "b u v l"]:
        """Unit-size code vectors of the next frame, not aligned, from those of three frames and action ids."""
        b, frames, u, v, code = context.shape
        tokens = jnp.concatenate([context, jnp.zeros_like(context[:, :1])], axis=1)
        x = self.enter(tokens.reshape(b, frames + 1, u * v, code))
        x = x + self.place_table.embedding[...][None, None] + self.frame_table.embedding[...][None, :, None]
        x = x + self.action_table(action)[:, None, None]
        for block in self.blocks:
            x = block(x)
        return self.leave(self.norm(x[:, -1])).reshape(b, u, v, code)


@typing.no_type_check
@flax.struct.dataclass
class FeedForwardDynamics:
    """Trained weights of autoencoder and transformer, statistics that bring maps and codes to unit size; static, sizes.

    codebook (k, l); map_mean (t, 3) and map_scale () of normalised texels; code_mean (l,) and code_scale ().
    """

    vae: Params
    codebook: Float[Array, "k l"]
    transformer: Params
    map_mean: Float[Array, "t 3"]
    map_scale: Float[Array, ""]
    code_mean: Float[Array, "l"]
    code_scale: Float[Array, ""]
    config: FeedForwardConfig = flax.struct.field(pytree_node=False)


def encode(atlas: Atlas, dynamics: FeedForwardDynamics, texels: Float[Array, "b t 3"]) -> Float[Array, "b u v l"]:
    """The encoder's vectors of normalised texels, before they are aligned to the codebook."""
    vae = bind(VAE, dynamics.config.vae, dynamics.vae)
    return vae.encode(latent.to_images(atlas, dynamics, texels))[0]


def decode(atlas: Atlas, dynamics: FeedForwardDynamics, entries: Float[Array, "b u v l"]) -> Float[Array, "b t 3"]:
    """Normalised texels of code vectors."""
    vae = bind(VAE, dynamics.config.vae, dynamics.vae)
    return latent.from_images(atlas, dynamics, vae.decode(entries))


def codes(atlas: Atlas, dynamics: FeedForwardDynamics, texels: Float[Array, "b t 3"]) -> Int[Array, "b u v"]:
    """Numbers of the codebook's entries that stand for normalised texels."""
    return vq.nearest(dynamics.codebook, encode(atlas, dynamics, texels))


def reconstruct(atlas: Atlas, dynamics: FeedForwardDynamics, texels: Float[Array, "b t 3"]) -> Float[Array, "b t 3"]:
    """Normalised texels through the codebook and back."""
    return decode(atlas, dynamics, dynamics.codebook[codes(atlas, dynamics, texels)])


def vqvae_loss(
    atlas: Atlas, dynamics: FeedForwardDynamics, texels: Float[Array, "b t 3"]
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Reconstruction on the foreground, codebook and commitment (van den Oord et al. 2017, Eq. 3); also the error in
    normalised units and how many codes the batch uses."""
    vectors = encode(atlas, dynamics, texels)
    chosen = vq.nearest(dynamics.codebook, vectors)
    entries = dynamics.codebook[chosen]
    decoded = decode(atlas, dynamics, vq.straight_through(vectors, entries))
    squared = jnp.mean((decoded - texels) ** 2)
    loss = squared / dynamics.map_scale**2 + vq.codebook_loss(vectors, entries, dynamics.config.commitment)
    used = vq.perplexity(chosen, len(dynamics.codebook))
    return loss, {"rmse": jnp.sqrt(squared), "perplexity": used}


def prediction_loss(
    atlas: Atlas, dynamics: FeedForwardDynamics, groups: Float[Array, "b 4 t 3"], action: Int[Array, "b"]
) -> Float[Array, ""]:
    """Mean squared error of the fourth frame's unit-size code vectors."""
    b, frames, t, _ = groups.shape
    chosen = codes(atlas, dynamics, groups.reshape(b * frames, t, 3))
    tokens = _unit_codebook(dynamics)[chosen.reshape(b, frames, *chosen.shape[1:])]
    return jnp.mean((_transform(dynamics, tokens[:, :-1], action) - tokens[:, -1]) ** 2)


def predict(
    atlas: Atlas, dynamics: FeedForwardDynamics, context: Float[Array, "b 3 t 3"], action: Int[Array, "b"]
) -> Float[Array, "b t 3"]:
    """The next frame's normalised texels from three normalised frames."""
    b, frames, t, _ = context.shape
    chosen = codes(atlas, dynamics, context.reshape(b * frames, t, 3))
    unit = _unit_codebook(dynamics)
    tokens = _transform(dynamics, unit[chosen.reshape(b, frames, *chosen.shape[1:])], action)
    return decode(atlas, dynamics, dynamics.codebook[vq.nearest(unit, tokens)])


def _unit_codebook(dynamics: FeedForwardDynamics) -> Float[Array, "k l"]:
    return (dynamics.codebook - dynamics.code_mean[None]) / dynamics.code_scale


def _transform(
    dynamics: FeedForwardDynamics, context: Float[Array, "b 3 u v l"], action: Int[Array, "b"]
) -> Float[Array, "b u v l"]:
    return bind(Transformer, dynamics.config, dynamics.transformer)(context, action)
