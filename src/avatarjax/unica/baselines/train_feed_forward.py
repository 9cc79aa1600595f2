"""Training of the feed-forward pipeline (UNICA D.1): the very batches, steps and rates of the autoencoder and the UNet.

The paper says nothing of its training. Action embeddings are learned throughout, contexts get no noise and actions are
not dropped: there is no guidance.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from avatarjax.data.dataset import Dataset
from avatarjax.nets import functional
from avatarjax.train import Run, train_stage
from avatarjax.unica.baselines import feed_forward
from avatarjax.unica.baselines.feed_forward import FeedForwardConfig, FeedForwardDynamics, Transformer
from avatarjax.unica.config import UnicaConfig
from avatarjax.unica.train import frame_batches, group_batches, map_statistics, sample_groups
from avatarjax.unica.vae import VAE

SAMPLED = 64  # groups on which codebook and statistics are based


def train(config: UnicaConfig, data: Dataset, run: Run) -> FeedForwardDynamics:
    """Both stages at the sizes that go with the run's UNet (`feed_forward.sized`), resumed where they were left."""
    start = new_dynamics(config, data, run, feed_forward.sized(config))
    return train_transformer(config, data, run, train_vqvae(config, data, run, start))


def new_dynamics(config: UnicaConfig, data: Dataset, run: Run, sizes: FeedForwardConfig) -> FeedForwardDynamics:
    """Untrained autoencoder and transformer with the statistics of the maps; the codebook's entries are what the
    untrained encoder says of random places of training maps, so that all of them are near something."""
    mean, scale = map_statistics(config, data)
    width = sizes.vae.latent_channels
    start = FeedForwardDynamics(
        vae=functional.init(VAE, sizes.vae, run.key("vqvae")),
        codebook=jnp.zeros((sizes.codes, width)),
        transformer=functional.init(Transformer, sizes, run.key("transformer")),
        map_mean=mean,
        map_scale=scale,
        code_mean=jnp.zeros(width),
        code_scale=jnp.ones(()),
        config=sizes,
    )
    vectors = jax.jit(feed_forward.encode)(data.atlas, start, _sampled(config, data)).reshape(-1, width)
    return start.replace(codebook=jax.random.choice(run.key("codebook"), vectors, (sizes.codes,)))


def train_vqvae(config: UnicaConfig, data: Dataset, run: Run, start: FeedForwardDynamics) -> FeedForwardDynamics:
    """Autoencoder and codebook, with the statistics of the codes that training maps use."""
    frames_at = frame_batches(config, data, run.seed)

    def batch_at(step):
        return {"atlas": data.atlas, "frozen": start.replace(vae={}, transformer={}), "texels": frames_at(step)}

    def loss(params, key, batch):
        return feed_forward.vqvae_loss(batch["atlas"], batch["frozen"].replace(**params), batch["texels"])

    settings, initial = (start.config, config.rotate), {"vae": start.vae, "codebook": start.codebook}
    trained = start.replace(**train_stage(run, "vqvae", config.vae_stage, settings, loss, initial, batch_at))
    used = trained.codebook[jax.jit(feed_forward.codes)(data.atlas, trained, _sampled(config, data))]
    mean = used.mean((0, 1, 2))
    # One scale for all channels: what is nearest must not change. An autoencoder of a single code has no scale.
    return trained.replace(code_mean=mean, code_scale=jnp.maximum((used - mean[None, None, None]).std(), 1e-3))


def train_transformer(config: UnicaConfig, data: Dataset, run: Run, start: FeedForwardDynamics) -> FeedForwardDynamics:
    """The transformer, on the codes of the trained autoencoder."""
    groups_at = group_batches(config, data, run.seed)

    def batch_at(step):
        return {"atlas": data.atlas, "frozen": start.replace(transformer={}), **groups_at(step)}

    def loss(params, key, batch):
        dynamics = batch["frozen"].replace(transformer=params)
        return feed_forward.prediction_loss(batch["atlas"], dynamics, batch["groups"], batch["actions"]), {}

    turns = (config.turn_window, config.turn_fraction, config.rotate)
    settings = (start.config, config.vae_stage, config.unet_steady, *turns)
    params = train_stage(run, "transformer", config.unet_stage, settings, loss, start.transformer, batch_at)
    return start.replace(transformer=params)


def _sampled(config: UnicaConfig, data: Dataset) -> jax.Array:
    """Normalised texels (4 SAMPLED, t, 3) spread over the training data."""
    groups = sample_groups(config, data, SAMPLED)
    return jnp.asarray(groups.reshape(-1, *groups.shape[2:]))
