"""SMAD end to end at the smallest sizes: films, Gaussians, dynamics, the report, and a second run that reuses."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import avatarjax as aj
from avatarjax.data import load_monocular
from avatarjax.data.motion import performances
from avatarjax.smad import config as configs
from avatarjax.smad import driving, refine
from avatarjax.smad.config import DynamicsConfig, FilmConfig, PicturesConfig
from avatarjax.smad.fusion import FusionConfig
from avatarjax.smad.graph import GraphConfig
from avatarjax.smad.radiance_field import FieldConfig
from avatarjax.train import StageConfig
from experiments import smad as experiment
from experiments import smad_measures as measures
from experiments import smad_motions
from experiments.tables import __main__ as tables
from experiments.tables import deformers, fusion, initialisation

CI = configs.preset("ci")
FRAMES = 26


def tiny():
    return dataclasses.replace(
        CI,
        film=FilmConfig(48, 4, (("turn", 0), ("arcs", 0)), (("arcs", 1),), ()),
        hull=dataclasses.replace(CI.hull, resolution=32, fraction=0.8, gaussians=200),
        refine=dataclasses.replace(CI.refine, steps=4),
        graph=GraphConfig(60, 4),
        dynamics=DynamicsConfig(target_stage=StageConfig(3, 4, 1e-3)),
        pictures=PicturesConfig(StageConfig(4, 2, 1e-3), StageConfig(2, 2, 1e-3), frames=3, drawn=2),
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    whole = performances.perform

    def short(rig, name, seed):
        # Every tenth frame of a turn, so that the person is seen from all sides; the start of another.
        step = 9 if name == "turn" else 1
        return jax.tree.map(lambda x: x[: FRAMES * step : step], whole(rig, name, seed))

    out = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(configs.PRESETS, "ci", tiny)
        patch.setattr(performances, "perform", short)
        yield experiment.run_experiment(experiment.Args(preset="ci", out=out))


def test_everything_that_is_promised_is_written(finished):
    for name in ("config.json", "metrics.json", "report.html", "test.mp4", "test.png", "avatar.safetensors"):
        assert (finished / name).stat().st_size > 100, name
    page = (finished / "report.html").read_text()
    for text in ("How it moves", "skinning", "loose nodes", "PSNR in the mask", "Environment", "natural frequencies"):
        assert text in page
    found = json.loads((finished / "metrics.json").read_text())
    assert set(found) == {"train arcs-0", "test arcs-1", "seconds", "frames a second"}
    assert found["frames a second"] > 1
    for views in ("pictures", "novel views"):
        assert all(0 < kinds["PSNR"]["mean"] < 50 for kinds in found["test arcs-1"][views].values())
    errors = found["test arcs-1"]["nodes"]["all nodes"]
    assert set(errors) == {"ours", "equilibrium alone", "skinning"}
    assert all(0 < error["mean"] < 500 for error in errors.values())


def test_the_trained_avatar_loads_and_rolls_out(finished):
    avatar = aj.smad.load(finished)
    take = load_monocular(finished / "film" / "arcs-1")
    poses = driving.recorded(take.poses)
    state = aj.smad.reset(avatar, jax.tree.map(lambda x: x[0], poses))
    _, frames = jax.jit(aj.smad.rollout)(avatar, state, poses)
    picture = aj.render(jax.tree.map(lambda x: x[-1], frames.gaussians), take.camera_at(len(take) - 1))
    drawn = np.asarray(picture.alpha) > 0.5
    both, either = (drawn & take.masks[-1]).sum(), (drawn | take.masks[-1]).sum()
    assert both > 0.4 * either


def test_a_table_is_made_of_it(finished):
    args = tables.Args(("monocular",), preset="ci", avatars=("ghostlady",), out=finished.parents[2])
    (table,) = tables.run_tables(args)
    found = json.loads((finished / "metrics.json").read_text())["test arcs-1"]
    (row,) = [row for row in table.rows if row[:3] == ["ghostlady", "another seed", "ours"]]
    assert row[3].mean == found["pictures"]["ours"]["PSNR"]["mean"]
    assert row[6].mean == found["novel views"]["ours"]["PSNR"]["mean"]
    assert row[-1].mean == found["nodes"]["loose nodes"]["ours"]["mean"]
    assert any("PSNR: best in the paper ours, here" in remark for remark in table.remarks)


def test_what_gaussians_begin_with_is_compared(finished, capsys, monkeypatch):
    """Of the films of a run; a second table measures nothing. The hull alone is refined: compiling that step for each
    would take most of the time."""
    whole, refined = refine.refine, []

    def once(takes, cloud, net, pose, config, *rest):
        refined.append(len(cloud))
        begin = refine.start(takes, cloud, net, pose, config.knot)
        return whole(takes, cloud, net, pose, config, *rest) if len(refined) == 1 else begin

    monkeypatch.setattr(refine, "refine", once)
    monkeypatch.setitem(initialisation.FIELDS, "ci", FieldConfig(cells=16, width=8, layers=2, steps=60, kappa=0.05))
    monkeypatch.setattr(initialisation, "SEEDS", (0,))
    args = tables.Args(("initialisation",), preset="ci", avatars=("ghostlady",), out=finished.parents[2])
    (table,) = tables.run_tables(args)
    assert refined == [row[3] for row in table.rows[::4]]
    kinds = [tuple(row[1:3]) for row in table.rows[::2]]
    assert kinds == [(m, s) for m in initialisation.METHODS for s in initialisation.STATES]
    for row in table.rows:
        psnr, *_, ssim, _ = row[6:]
        assert 5 < psnr.mean < 50 and 0 < ssim.mean < 1 and 20 < row[3] < 400
        assert psnr.n == 5
    assert sum("radiance field less body template" in remark for remark in table.remarks) >= 4
    assert (finished.parents[2] / "tables" / "ci" / "initialisation.png").stat().st_size > 1000
    assert "measuring" in capsys.readouterr().out
    (again,) = tables.run_tables(args)
    assert again.markdown() == table.markdown() and "measuring" not in capsys.readouterr().out


def test_deformers_are_compared_from_the_same_equilibrium(finished, capsys, monkeypatch):
    """On takes of the run and on a long one. Only an MLP is learned, which compiles quickest, and in the place of ours;
    what does without a swing is as the run's own report says."""
    some = {name: deformers.METHODS[name] for name in ("ours", "skinning")}
    monkeypatch.setattr(deformers, "METHODS", some | {"ours": deformers.METHODS["MLP"]})
    monkeypatch.setattr(deformers, "LONG", {("arcs", 2): "dynamic pose"})
    monkeypatch.setattr(deformers, "STILL", "ours")
    monkeypatch.setattr(deformers, "EQUILIBRIUM", "skinning")
    monkeypatch.setattr(smad_motions, "perform", lambda rig, name: jax.device_get(performances.perform(rig, *name)))
    monkeypatch.setattr(jax, "clear_caches", lambda: None)
    args = tables.Args(("deformers",), preset="ci", avatars=("ghostlady",), out=finished.parents[2])
    (made,) = tables.run_tables(args)
    assert [row[1] for row in made.rows] == list(some)
    found = json.loads((finished / "metrics.json").read_text())["test arcs-1"]["pictures"]
    for row in made.rows:
        method, train, test, unseen, ahead = row[1], row[3], row[4], row[5], row[-1]
        assert 5 < test.mean < 50 and train.n == test.n == 3 and unseen is None
        assert ahead.mean == pytest.approx(made.rows[0][4].mean - test.mean, abs=1e-4)
        if method == "skinning":
            assert test.mean == pytest.approx(found[method]["PSNR"]["mean"], abs=1e-3)
    assert "pairs of methods" in made.remarks[0]
    (chosen,) = tables.run_tables(dataclasses.replace(args, methods=("ours",)))
    assert chosen.rows == made.rows[:1]
    with pytest.raises(ValueError, match="unknown method 'theirs'"):
        tables.run_tables(dataclasses.replace(args, methods=("theirs",)))
    checkpoints = finished.parents[2] / "tables" / "ci" / "deformers" / "ghostlady"
    assert {path.parent.name for path in checkpoints.glob("*/swing.safetensors")} == {"ours"}
    monkeypatch.setattr(measures, "EVERY", 1)
    monkeypatch.setattr(deformers, "PIECE", 1)
    args = dataclasses.replace(args, names=("long_takes",))
    (long,) = tables.run_tables(args)
    assert [row[2] for row in long.rows] == list(some)
    assert all(
        row[4].n == FRAMES - measures.SETTLE and row[-1].low <= row[-1].mean <= row[-1].high for row in long.rows
    )
    assert "measuring" in capsys.readouterr().out
    (again,) = tables.run_tables(args)
    assert again.markdown() == long.markdown() and "measuring" not in capsys.readouterr().out


def test_ways_to_colour_are_compared(finished, monkeypatch):
    """Before anything is learned a view that is trusted fully changes pictures; own colours give the run's own."""
    short = StageConfig(1, 1, 0.0)
    methods = {fusion.OWN: FusionConfig(views=0, stage=short), "attention alone": FusionConfig(3, stage=short)}
    monkeypatch.setattr(fusion, "METHODS", methods)
    args = tables.Args(("fusion",), preset="ci", avatars=("ghostlady",), out=finished.parents[2])
    (table,) = tables.run_tables(args)
    run = json.loads((finished / "metrics.json").read_text())["test arcs-1"]
    assert [row[2:4] for row in table.rows] == [[v, m] for v in (fusion.RECORDED, fusion.NOVEL) for m in methods]
    for own, other in (table.rows[:2], table.rows[2:]):
        views = "pictures" if own[2] == fusion.RECORDED else "novel views"
        assert own[4].mean == pytest.approx(run[views]["ours"]["PSNR"]["mean"], abs=1e-3)
        assert other[-1].mean == pytest.approx(other[4].mean - own[4].mean, abs=1e-4) and other[-1].mean != 0


def test_a_second_run_reuses_and_a_stage_runs_anew(finished, capsys):
    def times():
        return {p.name: p.stat().st_mtime_ns for p in (finished / "checkpoints").glob("*.safetensors")}

    before = times()
    args = experiment.Args(preset="ci", out=finished.parents[2], stage="dynamics")
    experiment.run_experiment(args)
    changed = {name for name, time in times().items() if time != before[name]}
    assert changed == {f"{stage}.safetensors" for stage in ("dynamics_target", "drape", "swing")}
    assert "report:" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"avatar": "nobody"}, "unknown avatar 'nobody'.*ghostlady"),
        ({"stage": "cook"}, "unknown stage 'cook'.*refine"),
        ({"test": ("somewhere",)}, "--test needs --videos"),
        ({"preset": "huge"}, "unknown preset 'huge'.*small"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        experiment.run_experiment(experiment.Args(out=tmp_path, **changes))
