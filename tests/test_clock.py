"""The times of a run's stages: kept over several runs of the program."""

import json

import pytest

from experiments import clock
from experiments.clock import Clock


@pytest.fixture
def ticking(monkeypatch):
    """Makes the next piece of work take so many seconds."""
    now = [0.0]
    monkeypatch.setattr(clock.time, "monotonic", lambda: now[0])
    return lambda seconds: lambda: now.__setitem__(0, now[0] + seconds)


def test_a_stage_that_is_read_back_keeps_the_time_it_took(tmp_path, ticking):
    Clock(tmp_path / "seconds.json").run("train", ticking(90.0))
    again = Clock(tmp_path / "seconds.json")
    again.run("train", ticking(0.2))
    assert again.seconds == json.loads((tmp_path / "seconds.json").read_text()) == {"train": 90.0}


def test_work_that_goes_on_adds_to_its_time(tmp_path, ticking):
    for seconds in (40.0, 15.0):
        Clock(tmp_path / "seconds.json").run("data", ticking(seconds), resumed=True)
    assert Clock(tmp_path / "seconds.json").seconds == {"data": 55.0}


def test_interrupted_work_counts_and_its_error_is_seen(tmp_path, ticking):
    def work():
        ticking(7.0)()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Clock(tmp_path / "seconds.json").run("data", work)
    assert Clock(tmp_path / "seconds.json").seconds == {"data": 7.0}
