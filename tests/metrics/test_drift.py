import numpy as np
import pytest

from avatarjax.metrics import drift


@pytest.fixture(scope="module")
def clouds():
    rng = np.random.default_rng(0)
    return rng.normal(size=(11, 7, 3)).astype(np.float32), rng.normal(size=(20, 7, 3)).astype(np.float32)


@pytest.mark.parametrize("chunk", [4, 256])
def test_distances_are_those_of_brute_force(clouds, chunk):
    frames, training = clouds
    all_pairs = ((frames[:, None].astype(np.float64) - training[None]) ** 2).sum(-1).mean(-1)
    got = drift.nearest_distance(frames, training, chunk=chunk)
    np.testing.assert_allclose(got, np.sqrt(all_pairs.min(1)), rtol=1e-4)


def test_a_training_frame_is_near_itself(clouds):
    _, training = clouds
    np.testing.assert_allclose(drift.nearest_distance(training[:3], training), 0, atol=2e-3)


def test_moving_every_point_by_a_length_is_that_distance():
    training = np.random.default_rng(1).normal(size=(1, 50, 3)).astype(np.float32)
    moved = training + np.array([0.3, 0.0, -0.4], np.float32)
    np.testing.assert_allclose(drift.nearest_distance(moved, training), 0.5, rtol=1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_frames_that_are_not_finite_are_refused(clouds, value):
    frames, training = clouds
    broken = frames.copy()
    broken[3, 2, 1] = value
    with pytest.raises(ValueError, match="not finite"):
        drift.nearest_distance(broken, training)
