"""The comparison of ways to learn dynamics: its measures on motions that are known, and all of it at a small size."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from avatarjax.data.motion import performances
from avatarjax.smad import config as configs
from avatarjax.smad.config import DynamicsConfig
from avatarjax.smad.driving import Pose
from avatarjax.smad.graph import GraphConfig
from avatarjax.smad.train_dynamics import Take
from avatarjax.train import StageConfig
from experiments import smad_dynamics as experiment
from experiments import smad_dynamics_measures as measures
from experiments import smad_dynamics_tables as tables
from experiments import smad_motions
from experiments.smad_motions import Motions

CI = configs.preset("ci")
FRAMES = 120  # of all takes, so that what is compiled for one serves all


def swinging(frames=120, late=0.0):
    """Points (t, 5, 3) that swing, so many frames late."""
    rng = np.random.default_rng(0)
    t = np.arange(frames)[:, None, None] - late
    return 0.1 * np.sin(0.23 * t + rng.uniform(0, 6, (5, 3))) + 0.05 * np.sin(0.41 * t + rng.uniform(0, 6, (5, 3)))


@pytest.mark.parametrize("late", [0.0, 2.0, -3.0, 1.5])
def test_a_delay_is_found_between_frames_too(late):
    mine, true = (np.diff(x, axis=0) for x in (swinging(), swinging(late=late)))
    assert measures.delay(mine, true) == pytest.approx(late, abs=0.1)


def test_a_delay_needs_frames_to_look_through():
    with pytest.raises(ValueError, match="30 frames, there are 9"):
        measures.delay(*2 * [swinging(9)])


def test_the_measures_of_a_take():
    truth, chosen = swinging(), np.array([1, 3])
    half = truth.mean(0) + 0.5 * (truth - truth.mean(0))
    moved = half.copy()
    moved[:, 3] += [0.03, 0.0, 0.04]
    found = measures.one_take(moved, truth, chosen, threshold=1e9)
    apart = 1000 * np.linalg.norm(moved - truth, axis=-1)[measures.SETTLE :]
    np.testing.assert_allclose([found["all"], found["loose"]], [apart.mean(), apart[:, chosen].mean()])
    assert found["swing"] == pytest.approx(0.5)
    assert found["lag"] == pytest.approx(0.0, abs=1.0)
    assert found["spikes"] == 0
    assert measures.one_take(truth, truth, chosen, 1.0)["acceleration"] == 0


def test_a_rollout_that_diverged_has_an_error_too():
    truth = swinging()
    take = Take(Pose(*(jnp.zeros((len(truth), 1)) for _ in range(3))), jnp.asarray(truth, jnp.float32))
    away = np.where(np.arange(len(truth))[:, None, None] > 50, np.nan, truth)
    found = measures.measure(
        lambda *_: away, {"test": {("arcs", 0): take}}, np.array([0]), lambda *_: 0.9 * np.asarray(truth)
    )
    assert 1000 < found["test"]["loose"][0] < 1000 * np.sqrt(3) * measures.LOST


def test_errors_that_grow_are_told():
    truth = np.zeros((300, 2, 3))
    nodes = truth + np.arange(300)[:, None, None] * [1e-5, 0, 0]
    found = measures.long_errors(nodes, truth, np.array([0, 1]))
    assert found["growth"][0] == pytest.approx(10.0, rel=1e-4)
    assert len(found["curve"]) == 9


def fabricated(loose, likeness=(0.9, 0.5), windows=(10.0, 20.0), seconds=3.0):
    """What is found of a method on one motion of each part."""
    part = {"loose": [loose], "windows": [list(windows)]}
    similarity = {"test": [list(likeness)], "unseen": [list(likeness)]}
    return [{"train": part, "test": part, "unseen": part, "seconds": seconds, "similarity": similarity}]


def test_weights_are_in_order_and_the_presets_last():
    results = {"ours": fabricated(5.0), "isometry 1": fabricated(9.0), "isometry 0.01": fabricated(4.0)}
    made = tables.weights_table(results, tables.ISOMETRY)
    assert [row[0] for row in made.rows] == [0.01, 1.0, "the preset's"]
    assert [row[2].mean for row in made.rows] == [4.0, 9.0, 5.0]


def test_lengths_of_training_are_in_order_after_what_needs_none():
    results = {"ours": fabricated(5.0), "ridge regression": fabricated(7.0)}
    results |= {f"{n:g}{tables.LENGTH}": fabricated(4.0, seconds=n) for n in (9.0, 0.1)}
    made = tables.length_table(results)
    assert [row[:2] for row in made.rows] == [
        ["ridge regression", 0.0],
        ["0.1 times the steps", 0.1],
        ["ours", 3.0],
        ["9 times the steps", 9.0],
    ]


@pytest.mark.parametrize(("ours", "verdict"), [((10.0, 11.0), ": reproduced"), ((10.0, 30.0), "not reproduced")])
def test_whether_errors_stay_as_they_are_far_from_training_is_said(ours, verdict):
    results = {name: fabricated(1.0) for name in ("skinning", "ridge regression")}
    results["ours"] = fabricated(1.0, windows=ours)
    made = tables.similarity_table(results)
    assert verdict in made.remarks[0] and "skinning" in made.remarks[0]
    assert made.rows[0][0] == "0.500 to 0.500" and made.rows[-1][0] == "0.900 to 0.900"


def tiny():
    net = dataclasses.replace(CI.deformer, hidden=16, message=8, decoder=(16, 8), pose_width=16, pose_embedding=8)
    return dataclasses.replace(
        CI,
        film=dataclasses.replace(CI.film, substeps=2),
        graph=GraphConfig(40, 4),
        deformer=net,
        dynamics=DynamicsConfig(frames=3, target_stage=StageConfig(60, 16, 1e-2), stage=StageConfig(2, 2, 1e-3)),
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    whole = performances.perform
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(configs.PRESETS, "ci", tiny)
        patch.setattr(
            performances, "perform", lambda *a: jax.tree.map(lambda x: x[: 1 if a[1] == "turn" else FRAMES], whole(*a))
        )
        patch.setattr(smad_motions, "KEPT", 200)
        patch.setattr(smad_motions, "LONG", FRAMES)
        patch.setattr(
            experiment,
            "MOTIONS",
            Motions((("arcs", 0), ("dance", 0)), (("arcs", 1), ("dance", 1)), (("kicks", 0),), (("run", 0),)),
        )
        args = experiment.Args(methods=("A0 base",), motions=(2, 1), out=tmp_path_factory.mktemp("runs"))
        yield experiment.run(args), args


def test_all_methods_and_yardsticks_are_measured(finished):
    folder, _ = finished
    both = json.loads((folder / "dynamics.json").read_text())
    found, less = both["2"], both["1"]
    assert set(less) == {tables.TWINS, *tables.YARDSTICKS, "ours"}
    assert found["mean drape"][0]["test"]["loose"] != less["mean drape"][0]["test"]["loose"]
    assert set(found) == {tables.TWINS, *tables.YARDSTICKS, "ours", "A0 base"}
    errors = {name: np.mean(seeds[0]["test"]["loose"]) for name, seeds in found.items()}
    assert 0 < errors["twins"] < errors["skinning"]
    # Only the tests have twins.
    assert not found["twins"][0]["unseen"]
    page = (folder / "dynamics.md").read_text()
    for text in ("| mean drape |", "pairs", "run-0", "A0 base", "lag, ms", "How much motion", "Fig. J"):
        assert text in page
    for name in ("motions2/nodes.png", "long-run-0.png", "similarity.png"):
        assert (folder / name).stat().st_size > 1000


def test_a_second_run_reads_back(finished, capsys):
    folder, args = finished
    before = (folder / "motions2" / "ours" / "seed0" / "measures.json").stat().st_mtime_ns
    experiment.run(args)
    assert (folder / "motions2" / "ours" / "seed0" / "measures.json").stat().st_mtime_ns == before
    assert "ours, 2 motions, seed 0" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"avatar": "nobody"}, "unknown avatar 'nobody'.*ghostlady"),
        ({"methods": ("magic",)}, "unknown method 'magic'.*MLP"),
        ({"seeds": 0}, "at least one seed"),
        ({"motions": (18, 18)}, "different numbers from 1 to"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        experiment.run(experiment.Args(out=tmp_path, **changes))
