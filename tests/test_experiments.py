"""The command line of `experiments.unica`: what is refused, and how it is said. No training."""

import jax
import pytest

from experiments import unica as experiment


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"avatar": "knight"}, r"unknown avatar 'knight': choose one of .*cowgirl"),
        ({"preset": "huge"}, r"unknown preset 'huge': choose one of ci, small, base, paper"),
        ({"preset": "ci", "stage": "bake"}, r"unknown stage 'bake' here: choose one of all, data, .*report"),
    ],
)
class TestRefusal:
    def test_prepare_lists_the_choices(self, changes, message, tmp_path):
        with pytest.raises(ValueError, match=message):
            experiment.prepare(experiment.Args(**changes, out=tmp_path))
        assert not list(tmp_path.iterdir())

    def test_the_command_fails_with_one_line(self, changes, message, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(jax.config, "update", lambda *_: None)
        arguments = [part for name, value in changes.items() for part in (f"--{name}", value)]
        assert experiment.main([*arguments, "--out", str(tmp_path)]) == 1
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1


def test_help_mentions_every_stage(capsys):
    with pytest.raises(SystemExit) as stopped:
        experiment.main(["--help"])
    assert stopped.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for stage in experiment.STAGES:
        assert stage in shown


def test_an_unknown_option_is_refused(capsys):
    with pytest.raises(SystemExit) as stopped:
        experiment.main(["--colour", "red"])
    assert stopped.value.code == 2
    assert "colour" in capsys.readouterr().err


def test_a_run_has_its_folder_and_config(tmp_path):
    made = experiment.prepare(experiment.Args(preset="ci", out=tmp_path))
    assert made.folder == tmp_path / "unica" / "cowgirl" / "ci"
    assert (made.folder / "config.json").is_file()


def test_another_seed_has_its_own_folder(tmp_path):
    folders = [experiment.prepare(experiment.Args(preset="ci", seed=seed, out=tmp_path)).folder for seed in (0, 1)]
    assert [f.name for f in folders] == ["ci", "ci-seed1"]


def test_starting_over_deletes_only_this_run(tmp_path, capsys):
    folder = tmp_path / "unica" / "cowgirl"
    for preset in ("ci", "small"):
        (folder / preset).mkdir(parents=True)
        (folder / preset / "old.txt").write_text("old")
    experiment.prepare(experiment.Args(preset="ci", resume=False, out=tmp_path))
    assert not (folder / "ci" / "old.txt").exists() and (folder / "small" / "old.txt").exists()
    assert str(folder / "ci") in capsys.readouterr().out


def test_only_the_stages_of_the_chosen_models_are_run(tmp_path):
    both = experiment.prepare(experiment.Args(preset="ci", out=tmp_path))
    assert both.stages() == list(experiment.STAGES)
    one = experiment.prepare(experiment.Args(preset="base", out=tmp_path))
    assert "coefficients" not in one.stages() and "unet" in one.stages()
    with pytest.raises(ValueError, match="unknown stage 'coefficients' here"):
        experiment.prepare(experiment.Args(preset="base", stage="coefficients", out=tmp_path))
