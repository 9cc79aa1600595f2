"""The comparison of dynamics models at the smallest sizes: what is written, resumed and refused."""

import dataclasses
import json
import typing

import numpy as np
import pytest

from avatarjax.data import dataset
from avatarjax.unica import config as configs
from experiments import unica_dynamics as dynamics
from experiments import unica_dynamics_measures as measures
from tests.unica.conftest import TINY

MODELS = ("coefficients", "unet-turned")
STAGES = {"coefficients", "vae", "unet"}


@pytest.fixture(scope="module")
def compared(tiny_data, tmp_path_factory):
    """The folder of a comparison that was run, and its arguments."""
    args = dynamics.Args(models=MODELS, seeds=1, frames=65, out=tmp_path_factory.mktemp("runs"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(configs.PRESETS, "ci", lambda: TINY)
        patch.setattr(dynamics, "prepare_data", lambda *_: tiny_data)
        patch.setattr(dataset, "fingerprint", lambda _: "tiny")
        patch.setattr(dynamics, "timed_config", lambda _, config, *__: config)
        for name, value in {"GROUPS": 6, "STEP_GROUPS": 3, "SAMPLING_STEPS": (2,), "AHEAD": 3, "TIMED": 2}.items():
            patch.setattr(measures, name, value)
        folder = dynamics.run(args)
        before = {p: p.stat().st_mtime_ns for p in folder.rglob("*.safetensors")}
        dynamics.run(args)
    return folder, before


def test_the_table_has_a_row_a_measure_and_a_column_a_model(compared):
    lines = (compared[0] / "dynamics.md").read_text().splitlines()[2:]
    assert lines[0] == "|  | coefficients | unet-turned | constant velocity, or controller |"
    for what in ("next frame in turns, mm", "autoencoder alone", "keys obeyed", "diversity", "drift", "ms a frame"):
        (row,) = [line for line in lines if what in line][:1]
        assert row.count("|") == 5


def test_all_numbers_and_plots_are_written(compared):
    folder, _ = compared
    whole = json.loads((folder / "dynamics.json").read_text())
    for name in MODELS:
        (run,) = whole["models"][name]
        assert np.isfinite(run["next_frame"]["model"]).all() and len(run["next_frame"]["model"]) == 6
        assert list(run["sampling_steps"]) == ["2"] and len(run["diversity"]["pose"]) == 3
        assert run["ms_a_frame"] > 0 and set(run["seconds"]) == set(run["steps"]) <= STAGES
    assert "autoencoder" in whole["models"]["unet-turned"][0]["next_frame"]
    for name in ("sampling_steps.png", "diversity.png", "path.png"):
        assert (folder / name).stat().st_size > 1000


def test_a_second_run_trains_nothing(compared):
    folder, before = compared
    assert before == {p: p.stat().st_mtime_ns for p in folder.rglob("*.safetensors")}


def test_the_clock_of_a_cpu_is_its_processor_time_and_starts_anew_where_a_run_was_resumed(tmp_path, monkeypatch):
    ticks = [(9.0, 1.0), (20.0, 3.0), (21.0, 0.5), (30.0, 2.5)]
    lines = [json.dumps({"step": k, "seconds": a, "processor_seconds": b}) for k, (a, b) in enumerate(ticks)]
    (tmp_path / "unet.jsonl").write_text("\n".join(lines))
    monkeypatch.setattr(dynamics.os, "cpu_count", lambda: 2)
    np.testing.assert_allclose(dynamics.intervals(tmp_path / "unet.jsonl"), [1.0, 1.0])


def test_the_steps_of_all_seeds_are_what_fits_into_the_seconds_and_measured_once(tmp_path, monkeypatch):
    """A step of 10 ms for the autoencoder and 40 ms for the UNet; every UNet takes the same number."""
    trained = []
    monkeypatch.setattr(dynamics, "train_dynamics", lambda *args: trained.append(args))
    monkeypatch.setattr(
        dynamics, "intervals", lambda path: np.array([9.0] + 5 * [0.01 if "vae" in path.name else 0.04])
    )
    args = dynamics.Args(seconds=100.0)
    for name in ("unet", "unet-turned"):
        config = dynamics.variant(configs.preset("ci"), name)
        timed = dynamics.timed_config(args, config, typing.cast(typing.Any, None), tmp_path, "data")
        assert (timed.vae_stage.steps, timed.unet_stage.steps) == (4000, 1500)
        assert timed.rotate == config.rotate
    assert len(trained) == 1


def test_next_frames_are_pooled_over_seeds_and_turns_are_told_apart():
    part = {"turning": [0, 0, 1, 1], "sequence": [0, 1, 0, 1]}
    runs = [{"next_frame": part | {"model": [1.0, 1, 5, 5]}}, {"next_frame": part | {"model": [3.0, 3, 7, 7]}}]
    assert dynamics.next_frame(runs, "model", False) == "4.0 [4.0, 4.0] (3.0 to 5.0)"
    assert dynamics.next_frame(runs, "model", True) == "6.0 [6.0, 6.0] (5.0 to 7.0)"
    assert dynamics.next_frame(runs, "autoencoder", False) == "none"


def test_the_papers_recipe_has_nothing_of_ours():
    paper = dynamics.variant(configs.preset("ci"), "unet-paper")
    assert paper.dynamics == "unet" and not paper.rotate
    latent = paper.latent
    assert (latent.vae.positions, latent.from_last, latent.min_snr, latent.noise_offset) == (0, False, 0.0, 0.0)
    turned, plain = (dynamics.variant(configs.preset("ci"), name) for name in ("unet-turned", "unet"))
    assert turned.rotate and dataclasses.replace(turned, rotate=False) == plain


@pytest.mark.parametrize(
    "changes, message", [({"avatar": "knight"}, "unknown avatar 'knight'"), ({"seeds": 0}, "at least one model")]
)
def test_what_cannot_be_compared_is_refused(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        dynamics.run(dynamics.Args(**changes, out=tmp_path))
    assert not list(tmp_path.iterdir())


def test_answers_are_counted_on_a_path_that_obeys_one_key_of_two():
    """Under both keys it runs along +z: right for the first, half a turn off for the second; idle it stands."""
    actions = np.repeat([1, 2, 0], 60)
    z = np.append(0.1 * np.arange(120), np.full(60, 12.0))
    path = np.stack([0 * z, 0 * z + 1, z], -1)
    found = measures.answers(path, actions, np.array([0.0, 0.0, np.pi]), np.array([0.0, 1.0, 1.0]))
    assert found["obeyed"] == 0.5 and found["heading_error"] == pytest.approx(90, abs=1)
    assert (found["turns_180"], found["turns_180_completed"], found["turn_frames_180"]) == (1, 0, None)
    assert found["idle_speed"] == pytest.approx(0, abs=0.1) and found["speed"] == pytest.approx(3, rel=1e-3)
