"""What is particular to a stage; that all of them run is tested with the main job, tests/test_unica_pipeline.py."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.posmap import pca
from avatarjax.train import StageConfig, read_metrics
from avatarjax.unica import batches, fit, train, train_appearance


@pytest.fixture(scope="module")
def few(config):
    return dataclasses.replace(
        config,
        unet_stage=StageConfig(6, 8, 1e-2),
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
    @staticmethod
    def handed_over(config, tiny_data, run, latent_dynamics, monkeypatch):
        """What the training of the UNet hands to the loop: batches by step, and what holds parameters."""
        handed = {}

        def loop(run, name, stage, config, loss, initial, batch_at, hold):
            handed.update(batch_at=batch_at, hold=hold, initial=initial)
            return initial

        monkeypatch.setattr(train, "train_stage", loop)
        train.train_unet(config, tiny_data, run, latent_dynamics)
        return handed

    @pytest.fixture
    def stage(self, few, tiny_data, run, latent_dynamics, monkeypatch):
        return self.handed_over(few, tiny_data, run, latent_dynamics, monkeypatch)

    def test_the_first_stage_comes_first_and_learns_the_embeddings(self, stage):
        assert [bool(stage["batch_at"](k)["steady"]) for k in range(6)] == [True] * 3 + [False] * 3

    def test_embeddings_are_frozen_in_the_second_stage_and_nothing_else_is(self, stage):
        old = stage["initial"]
        new = jax.tree.map(lambda x: x + 1, old)
        first, second = (stage["hold"](new, old, stage["batch_at"](k)) for k in (0, 5))
        jax.tree.map(np.testing.assert_array_equal, first, new)
        np.testing.assert_array_equal(second["action_table"]["embedding"], old["action_table"]["embedding"])
        rest = [{k: v for k, v in tree.items() if k != "action_table"} for tree in (second, new)]
        jax.tree.map(np.testing.assert_array_equal, *rest)

    def test_the_first_stage_sees_steady_movement_only(self, stage, few, tiny_data):
        windows = batches.windows(tiny_data.train, 4, few.turn_window)
        groups, _ = windows.groups(np.flatnonzero(windows.turning), float(tiny_data.atlas.scale))
        known = {g.tobytes() for g in groups}
        turning = [np.mean([g.tobytes() in known for g in stage["batch_at"](k)["groups"]]) for k in range(6)]
        assert max(turning[:3]) == 0 and max(turning[3:]) > 0

    @pytest.mark.parametrize("window", [(0, 25), (-5, 40)])
    def test_the_turning_window_reaches_both_stages(self, few, tiny_data, run, latent_dynamics, monkeypatch, window):
        config = dataclasses.replace(few, turn_window=window, turn_fraction=1.0)
        batch_at = self.handed_over(config, tiny_data, run, latent_dynamics, monkeypatch)["batch_at"]
        windows = batches.windows(tiny_data.train, 4, window)
        groups, _ = windows.groups(np.flatnonzero(windows.turning), float(tiny_data.atlas.scale))
        known = {g.tobytes() for g in groups}
        turning = [{g.tobytes() in known for g in batch_at(k)["groups"]} for k in range(6)]
        assert turning == [{False}] * 3 + [{True}] * 3

    def test_turned_groups_come_with_turned_keys(self, few, tiny_data, run, latent_dynamics, monkeypatch):
        """The root moves where the key of a turned steady group asks, and every key meets every turn."""
        config = dataclasses.replace(few, rotate=True, unet_stage=StageConfig(6, 200, 1e-2))
        batch = self.handed_over(config, tiny_data, run, latent_dynamics, monkeypatch)["batch_at"](0)
        plain = self.handed_over(
            dataclasses.replace(config, rotate=False), tiny_data, run, latent_dynamics, monkeypatch
        )
        before = plain["batch_at"](0)
        root = np.einsum("t,bftc->bfc", np.asarray(tiny_data.atlas.waist), batch["groups"])
        step = root[:, 3] - root[:, 2]
        yaw = np.arctan2(step[:, 0], step[:, 2])
        asked = np.array([np.nan, 0, np.pi, np.pi / 2, -np.pi / 2])[batch["actions"]]
        apart = np.abs((yaw - asked + np.pi) % (2 * np.pi) - np.pi)
        assert np.nanmedian(apart) < 0.2 and np.nanmax(apart) < 1.0
        np.testing.assert_array_equal(batch["actions"] == 0, before["actions"] == 0)
        moving = before["actions"] > 0
        pairs = set(zip(before["actions"][moving].tolist(), batch["actions"][moving].tolist(), strict=True))
        assert len(pairs) == 16

    def test_a_batch_depends_on_its_step_alone(self, stage):
        one, again, other = (stage["batch_at"](k)["groups"] for k in (4, 4, 5))
        np.testing.assert_array_equal(one, again)
        assert not np.array_equal(one, other)


def test_what_keys_ask_for_is_measured_from_the_data(tiny_data, coefficient_frames):
    """W asks for +z, S for half a turn, A and D for a quarter; idle stands."""
    _, roots = coefficient_frames
    yaw, moves = fit.action_directions(roots, tiny_data.train.actions, tiny_data.train.sequence, 5)
    error = (yaw[1:] - np.array([0, np.pi, np.pi / 2, -np.pi / 2]) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(error, 0, atol=0.15)
    np.testing.assert_array_equal(moves, [0, 1, 1, 1, 1])


def test_base_attributes_learn_the_standing_pose(few, tiny_data, run, upscaler):
    base = train_appearance.train_base(few, tiny_data, run, upscaler)
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
