"""What is particular to a stage; that all of them run is tested with the main job, tests/test_unica_pipeline.py."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.posmap import pca
from avatarjax.train import read_metrics
from avatarjax.unica import batches, fit, train
from avatarjax.unica.config import StageConfig


@pytest.fixture(scope="module")
def few(config):
    # Windows of a turn and of steady movement both fit; no dropping, so that the action table gets a gradient.
    return dataclasses.replace(
        config,
        latent=dataclasses.replace(config.latent, action_dropout=0.0),
        unet_stage=StageConfig(6, 2, 1e-2),
        unet_steady=0.5,
        base_stage=StageConfig(16, 2, 1e-1),
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return train.Run(tmp_path_factory.mktemp("checkpoints"), 0, "tiny")


def losses(run, name):
    records = read_metrics(run.folder / f"{name}.jsonl")
    assert all(np.isfinite(r["loss"]) and r["skipped"] == 0 for r in records)
    return [r["loss"] for r in records]


class TestUnet:
    @pytest.fixture(scope="class")
    @staticmethod
    def tables(few, tiny_data, run, latent_dynamics):
        """The action table before, after the steady stage and after both, and the rest of the weights."""
        states = []
        original = train.make_step

        def recording(*args, **options):
            step = original(*args, **options)

            def recorded(state, batch):
                state, metrics = step(state, batch)
                table = np.asarray(state.params["action_table"]["embedding"])
                states.append((table, np.asarray(state.params["leave"]["kernel"]), bool(batch["learn_actions"])))
                return state, metrics

            return recorded

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(train, "make_step", recording)
            train.train_unet(few, tiny_data, run, latent_dynamics)
        return states

    def test_losses_stay_finite(self, tables, run):
        assert len(losses(run, "unet")) == 6

    def test_the_first_stage_comes_first(self, tables):
        assert [learn for _, _, learn in tables] == [True] * 3 + [False] * 3

    def test_embeddings_learn_in_the_first_stage(self, tables, latent_dynamics):
        assert np.abs(tables[2][0] - latent_dynamics.denoiser["action_table"]["embedding"]).max() > 1e-3

    def test_embeddings_are_frozen_in_the_second_stage(self, tables):
        for table, _, _ in tables[3:]:
            np.testing.assert_array_equal(table, tables[2][0])

    def test_the_network_goes_on_learning(self, tables):
        assert np.abs(tables[5][1] - tables[2][1]).max() > 1e-3


def test_what_keys_ask_for_is_measured_from_the_data(tiny_data, coefficient_frames):
    """W asks for +z, S for half a turn, A and D for a quarter; idle stands."""
    _, roots = coefficient_frames
    yaw, moves = fit.action_directions(roots, tiny_data.train.actions, tiny_data.train.sequence, 5)
    error = (yaw[1:] - np.array([0, np.pi, np.pi / 2, -np.pi / 2]) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(error, 0, atol=0.15)
    np.testing.assert_array_equal(moves, [0, 1, 1, 1, 1])


def test_base_attributes_learn_the_standing_pose(few, tiny_data, run, upscaler):
    base = train.train_base(few, tiny_data, run, upscaler)
    values = losses(run, "base")
    assert np.mean(values[-4:]) < 0.9 * np.mean(values[:4])
    assert base.colors.shape == (len(upscaler.rows), 3)


def test_the_alignment_basis_keeps_fourth_maps(few, tiny_data, run):
    basis = train.fit_alignment(few, tiny_data, run)
    windows = np.arange(0, 1000, 100)
    groups, _ = batches.windows(tiny_data.train, 4, few.turn_window).groups(windows, float(tiny_data.atlas.scale))
    fourth = jnp.asarray(groups[:, 3])
    aligned = jax.vmap(lambda x: pca.align(basis, x))(fourth)
    assert float(jnp.abs(aligned - fourth).mean()) < 0.2 * float(jnp.abs(fourth - fourth.mean(0)[None]).mean())


def test_every_stage_has_its_own_randomness(run):
    keys = [tuple(np.asarray(jax.random.key_data(run.key(stage)))) for stage in ("vae", "unet", "base")]
    assert len(set(keys)) == 3
