"""Training of the feed-forward pipeline: it learns, from the very batches that autoencoder and UNet learn from."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.train import StageConfig, read_metrics
from avatarjax.unica import train
from avatarjax.unica.baselines import feed_forward, train_feed_forward
from tests.unica.baselines.conftest import SIZES


@pytest.fixture(scope="module")
def few(config):
    return dataclasses.replace(config, vae_stage=StageConfig(24, 4, 3e-3), unet_stage=StageConfig(24, 4, 3e-3))


@pytest.fixture(scope="module")
def trained(few, tiny_data, tmp_path_factory):
    """The folder of a training of some dozen steps, and what came of it."""
    run = train.Run(tmp_path_factory.mktemp("feed_forward"), 0, "tiny")
    start = train_feed_forward.new_dynamics(few, tiny_data, run, SIZES)
    middle = train_feed_forward.train_vqvae(few, tiny_data, run, start)
    return run.folder, start, train_feed_forward.train_transformer(few, tiny_data, run, middle)


@pytest.mark.parametrize("stage", ["vqvae", "transformer"])
def test_a_short_training_lowers_the_loss(trained, stage):
    losses = [record["loss"] for record in read_metrics(trained[0] / f"{stage}.jsonl")]
    assert np.mean(losses[-6:]) < 0.9 * np.mean(losses[:3])


def test_training_moves_the_codebook_and_brings_its_codes_to_unit_size(few, trained, tiny_data):
    _, start, found = trained
    assert np.abs(found.codebook - start.codebook).max() > 1e-3
    groups = train.sample_groups(few, tiny_data, 64)
    texels = jnp.asarray(groups.reshape(-1, *groups.shape[2:]))
    used = np.asarray(found.codebook[jax.jit(feed_forward.codes)(tiny_data.atlas, found, texels)])
    unit = (used - np.asarray(found.code_mean)) / float(found.code_scale)
    np.testing.assert_allclose(unit.mean((0, 1, 2)), 0, atol=1e-3)
    assert unit.std() == pytest.approx(1, abs=1e-2)
    assert jax.tree.structure(found) == jax.tree.structure(start)


def test_every_entry_starts_where_the_encoder_says_something(trained, tiny_data):
    start = trained[1]
    assert len(np.unique(start.codebook, axis=0)) > SIZES.codes // 2


def test_batches_are_those_of_autoencoder_and_unet(few, trained, tiny_data, latent_dynamics, monkeypatch, tmp_path):
    handed = {}

    def loop(run, name, stage, settings, loss, initial, batch_at, hold=None):
        handed[name] = stage, batch_at
        return initial

    monkeypatch.setattr(train, "train_stage", loop)
    monkeypatch.setattr(train_feed_forward, "train_stage", loop)
    parts = few, tiny_data, train.Run(tmp_path, 0, "tiny")
    train.train_unet(*parts, train.train_vae(*parts, latent_dynamics))
    train_feed_forward.train_transformer(*parts, train_feed_forward.train_vqvae(*parts, trained[1]))
    for ours, theirs, names in (("vqvae", "vae", ["texels"]), ("transformer", "unet", ["groups", "actions"])):
        assert handed[ours][0] == handed[theirs][0]
        for step in (0, 20):
            batches = [handed[stage][1](step) for stage in (ours, theirs)]
            for name in names:
                np.testing.assert_array_equal(batches[0][name], batches[1][name])
