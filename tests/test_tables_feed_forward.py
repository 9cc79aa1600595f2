"""Feed-forward or diffusion: metres by hand, and what the numbers say of the paper's finding."""

import numpy as np
import pytest

from avatarjax.metrics.statistics import Estimate
from experiments.tables import feed_forward

YAW, MOVES = np.array([0, 0, np.pi, np.pi / 2, -np.pi / 2]), np.array([0.0, 1, 1, 1, 1])


def test_progress_counts_what_keys_ask_for():
    """2 m forwards under W, 1 m back under A, which asks for x; then 5 m under idle."""
    roots = np.array([[0, 1, 0], [0, 1, 2], [0, 1, 1], [0, 1, 6], [9, 1, 9]], float)
    found = feed_forward.travelled(roots[:4], np.array([1, 3, 0, 1]), YAW, MOVES)
    assert found["progress"] == pytest.approx(2) and found["path"] == pytest.approx(8)


@pytest.mark.parametrize("action, way", [(1, (0, 0, 3)), (2, (0, 0, -3)), (3, (3, 0, 0)), (4, (-3, 0, 0))])
def test_whoever_goes_where_a_key_asks_progresses_by_all_of_it(action, way):
    roots = np.linspace((1.0, 1.0, 1.0), np.add((1, 1, 1), way), 10)
    found = feed_forward.travelled(roots, np.full(10, action), YAW, MOVES)
    assert found["progress"] == pytest.approx(3) and found["path"] == pytest.approx(3)


def estimate(mean):
    return Estimate(mean, mean - 1, mean + 1, 9, 3)


@pytest.mark.parametrize(
    "ours, unet, verdict", [(9, 5, ": reproduced."), (5.5, 5, "not told apart"), (5, 9, "not reproduced.")]
)
def test_geometry_is_worse_only_beyond_the_intervals(ours, unet, verdict):
    assert verdict in feed_forward.geometry_finding(estimate(ours), estimate(unet))


@pytest.mark.parametrize(
    "ours, path, unet, verdict",
    [
        (0.1, 0.1, 0.9, ": reproduced."),
        (0.1, 0.8, 0.9, "it wanders"),
        (0.1, 0.1, 0.1, "true of both"),
        (0.8, 0.9, 0.9, "not reproduced."),
        (np.nan, np.nan, 0.9, "not reproduced."),
    ],
)
def test_standing_counts_where_diffusion_drives(ours, path, unet, verdict):
    assert verdict in feed_forward.driving_finding(ours, path, unet)


def test_clouds_are_drawn(tmp_path):
    surfaces = np.random.default_rng(0).normal(size=(20, 50, 3))
    feed_forward.draw_clouds(tmp_path / "clouds.png", {"a": surfaces, "b": surfaces})
    assert (tmp_path / "clouds.png").read_bytes()[:4] == b"\x89PNG"
