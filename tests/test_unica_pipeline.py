"""The main job end to end at the smallest sizes: every stage, both models, the report, and a second run that reuses."""

import dataclasses
import itertools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import avatarjax as aj
from avatarjax.unica import config as configs
from experiments import unica as experiment
from experiments.tables import __main__ as tables
from experiments.tables import figures, quality
from experiments.tables.finished import Finished
from tests.unica.conftest import TINY

SCRIPT = (1,) * 10 + (2,) * 10


def tiny():
    """Every stage of the smallest networks, on the dataset that other tests have as well."""
    return dataclasses.replace(
        TINY,
        pca_components=24,
        train_both=True,
        data=dataclasses.replace(TINY.data, cloth_steps=4, vertices="float16"),
        lpips_network="alex",
    )


@pytest.fixture(scope="module")
def finished(tiny_folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    shutil.copytree(tiny_folder, out / "unica" / "cowgirl" / "ci" / "data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(configs.PRESETS, "ci", tiny)
        patch.setattr(experiment, "SCRIPT", SCRIPT)
        yield experiment.run_experiment(experiment.Args(preset="ci", out=out))


def test_everything_that_is_promised_is_written(finished):
    expected = ["config.json", "metrics.json", "report.html", "video.mp4", "contact_sheet.png", "path.png", "frame.ply"]
    for name in [*expected, "avatar-coefficients.safetensors", "avatar-unet.safetensors"]:
        assert (finished / name).stat().st_size > 100, name
    for stage in ("vae", "unet", "coefficients", "base", "appearance", "texels"):
        assert (finished / "checkpoints" / f"{stage}.safetensors").is_file()
        assert (finished / "checkpoints" / f"{stage}.jsonl").read_text().count("\n") == 3


@pytest.mark.parametrize("dynamics", ["coefficients", "unet"])
def test_the_trained_avatar_loads_and_rolls_out(finished, dynamics):
    avatar = aj.load(finished, dynamics=dynamics)
    state = aj.unica.reset(avatar, jax.random.key(0))
    state, frame = jax.jit(aj.unica.step)(avatar, state, jnp.int32(1))
    assert frame.posmap.shape == (32, 32, 3)
    picture = aj.render(frame.gaussians, aj.look_at((0, 1, 4), (0, 1, 0), width=32, height=32))
    assert float(picture.alpha.max()) > 0.5


def test_the_report_names_every_stage_and_embeds_its_pictures(finished):
    page = (finished / "report.html").read_text()
    for text in (
        "Does it obey?",
        "against copy last",
        "autoencoder",
        "Alignment error",
        "Frames of turning",
        "Motion error",
        "Foot slide",
        "jaxlib",
        "point transformer, against",
        "texels, against",
        "What is poor",
    ):
        assert text in page
    assert page.count("data:image/png;base64") >= 8
    assert page.count("data:video/mp4;base64") == 1


def test_figures_are_made_of_it(finished, capsys):
    args = tables.Args(names=("components", "novelty", "strips", "summary"), preset="ci", out=finished.parents[2])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "SCRIPT", SCRIPT)
        made = tables.run_tables(args)
        assert "measuring cowgirl-ci, components" in capsys.readouterr().out
        tables.run_tables(dataclasses.replace(args, names=("components",)))
        assert "measuring" not in capsys.readouterr().out
    folder = args.out / "tables" / "ci"
    for table, name in zip(made, args.names, strict=True):
        assert (folder / f"{name}.md").read_text().startswith(table.markdown())
        assert (name == "summary") == (not table.pictures)
        assert all((folder / file).stat().st_size > 1000 for file, _ in table.pictures)
    errors = made[0].rows[0][1:]
    assert all(b < a for a, b in itertools.pairwise(errors))


def test_rigging_follows_the_true_skeleton(finished, monkeypatch):
    monkeypatch.setattr(quality, "EXAMPLES", 20)
    run = Finished(finished)
    posed, roots = quality.rigged_truth(run)
    truth = run.data.truth.texels[: len(posed)] + run.data.truth.roots[: len(posed), None]

    def error(texels):
        return np.linalg.norm(texels - truth, axis=-1).mean()

    stiff = run.data.train.texels.mean(0)[None] + roots[:, None]
    assert error(posed) < 0.3 * error(stiff)


def test_a_second_run_reuses_what_is_finished(finished, capsys):
    before = {p: p.stat().st_mtime_ns for p in (finished / "checkpoints").glob("*.safetensors")}
    args = experiment.Args(preset="ci", out=finished.parents[2], stage="texels")
    (finished / "checkpoints" / "texels.jsonl").unlink()
    experiment.run_experiment(args)
    printed = capsys.readouterr()
    assert "data: finished before, reused" in printed.out
    after = {p: p.stat().st_mtime_ns for p in (finished / "checkpoints").glob("*.safetensors")}
    changed = {p.stem for p in after if after[p] != before[p]}
    assert changed == {"texels"}


def test_a_damaged_dataset_is_named_with_the_way_out(finished):
    path = finished / "data" / "clips" / "truth-000.safetensors"
    whole = path.read_bytes()
    path.write_bytes(whole[:-10])
    try:
        with pytest.raises(ValueError, match=r"truth-000\.safetensors is damaged.*--stage data"):
            experiment.run_experiment(experiment.Args(preset="ci", out=finished.parents[2]))
    finally:
        path.write_bytes(whole)
