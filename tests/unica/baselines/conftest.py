"""Sizes that the tests of the feed-forward pipeline share."""

from avatarjax.unica.baselines.feed_forward import FeedForwardConfig
from avatarjax.unica.vae import VAEConfig

SIZES = FeedForwardConfig(
    vae=VAEConfig(channels=(8, 16, 16), residual_blocks=1, latent_channels=6),
    side=8,
    width=16,
    depth=2,
    heads=2,
    codes=32,
)
