"""The avatars that come with the package: whole, small, and obedient."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import avatarjax as aj
from avatarjax.io import weights
from avatarjax.metrics import responsiveness
from avatarjax.unica import files
from experiments import ship, unica, unica_shipped
from tests.caching import cache_restored

NAMES = sorted(files.shipped())
SCRIPT = (1,) * 50 + (3,) * 50 + (2,) * 50 + (0,) * 30


@pytest.fixture(scope="module", params=NAMES)
def shipped(request, tmp_path_factory):
    """Loaded by name, from a folder without runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("empty"))
        return aj.load(request.param)


def test_there_is_one():
    assert "cowgirl" in NAMES


@pytest.mark.parametrize("name", NAMES)
def test_its_file_is_small_and_says_how_it_was_made(name):
    path = files.shipped()[name]
    assert path.stat().st_size < 10e6
    made = weights.load_arrays(path)[1]["made"]
    assert f"--avatar {name} --train" in made["command"]
    assert made["seconds"]["coefficients"] > 0 and "images" in made["metrics"]


def test_it_obeys_its_keys(shipped):
    state = aj.unica.reset(shipped, jax.random.key(1))
    roll = jax.jit(aj.unica.rollout, static_argnames="gaussians")
    frames = roll(shipped, state, jnp.asarray(SCRIPT), gaussians=False)[1]
    roots = np.asarray(frames.root)
    yaw, moves = (np.asarray(x, np.float64) for x in (shipped.dynamics.action_yaw, shipped.dynamics.action_moves))
    answers = responsiveness.responses(roots, np.asarray(SCRIPT), yaw, moves)
    for answer in answers[:3]:
        assert answer["heading_error"] < 8 and answer["speed"] > 2.5
    assert answers[3]["speed"] < 0.6
    assert all(a["turn_frames"] is not None and a["turn_frames"] < 25 for a in answers[1:3])


def test_its_gaussians_are_a_figure_on_the_ground(shipped):
    state = aj.unica.reset(shipped, jax.random.key(1))
    _, frame = jax.jit(aj.unica.step)(shipped, state, 1)
    means = np.asarray(frame.gaussians.means)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(frame.gaussians))
    tall = float(shipped.standing[:, 1].max())
    assert -0.1 < means[:, 1].min() < 0.1 and abs(means[:, 1].max() - tall) < 0.1
    picture = aj.render(frame.gaussians, aj.look_at((0, 1, 4.2), (0, 0.9, 0), width=96, height=96))
    assert 0.03 < float((picture.alpha > 0.5).mean()) < 0.4


def test_the_main_command_shows_it(tmp_path, monkeypatch):
    monkeypatch.setattr(unica_shipped, "SCRIPT", (1,) * 6 + (2,) * 6)
    with cache_restored():
        assert unica.main(["--avatar", "cowgirl", "--out", str(tmp_path)]) == 0
    folder = tmp_path / "unica" / "cowgirl" / "shipped"
    for name in ("video.mp4", "contact_sheet.png", "path.png", "frame.ply"):
        assert (folder / name).stat().st_size > 1000
    page = (folder / "report.html").read_text()
    assert "--train" in page and "Does it obey?" in page


def test_a_run_without_a_report_is_not_shipped(tmp_path):
    with pytest.raises(ValueError, match=r"has no metrics\.json"):
        ship.ship(tmp_path)


def test_what_obeys_worse_does_not_replace_what_was_shipped(tmp_path, monkeypatch):
    run, shelf = tmp_path / "cowgirl" / "small", tmp_path / "shelf"
    run.mkdir(parents=True)
    shelf.mkdir()
    files.save(run / files.file_name("coefficients"), aj.load(files.shipped()["cowgirl"]))
    measured = {key: {} for key in ("seconds", "images", "turning", "stages", "foot_slide_mm")}
    (run / "metrics.json").write_text(json.dumps(measured))
    (shelf / "cowgirl.safetensors").write_bytes(b"what was there")
    monkeypatch.setattr(files, "SHIPPED", shelf)
    errors = iter([np.array([1.0]), np.array([5.0])])
    monkeypatch.setattr(ship, "headings", lambda avatar: next(errors))
    with pytest.raises(ValueError, match="obeys its keys worse"):
        ship.ship(run)
    assert [p.name for p in shelf.iterdir()] == ["cowgirl.safetensors"]
    assert (shelf / "cowgirl.safetensors").read_bytes() == b"what was there"
