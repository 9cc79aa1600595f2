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
    with pytest.raises(ValueError, match="frames must be finite"):
        drift.nearest_distance(broken, training)


def test_other_points_are_refused(clouds):
    with pytest.raises(ValueError, match=r"frames must have the shape \(any, 7, 3\)"):
        drift.nearest_distance(clouds[0][:, :6], clouds[1])


def autoregressive(rng, count, memory=0.8):
    noise = rng.normal(size=count)
    for k in range(1, count):
        noise[k] += memory * noise[k - 1]
    return noise


class TestTrend:
    def test_a_line_is_found_exactly(self):
        found = drift.trend(3.0 + 0.25 * np.arange(200.0))
        assert found.slope == pytest.approx(0.25) and found.intercept == pytest.approx(3.0)
        for curve in (found.line, found.lower, found.upper):
            np.testing.assert_allclose(curve, 3.0 + 0.25 * np.arange(200))
        assert found.std == pytest.approx(0, abs=1e-9)

    def test_flat_values_have_a_flat_line_without_a_band(self):
        found = drift.trend(np.full(150, 7.0))
        assert found.slope == 0 and found.slope_interval == (0, 0)
        np.testing.assert_array_equal(found.upper, found.lower)

    def test_the_line_is_that_of_least_squares(self):
        values = np.random.default_rng(0).normal(size=150)
        slope, intercept = np.polyfit(np.arange(150.0), values, 1)
        found = drift.trend(values)
        np.testing.assert_allclose([found.slope, found.intercept], [slope, intercept], atol=1e-10)

    def test_it_covers_the_true_line_of_correlated_values_about_as_often_as_it_says(self):
        rng = np.random.default_rng(1)
        truth = 0.01 * np.arange(400)
        slopes, middles = [], []
        for seed in range(150):
            found = drift.trend(truth + autoregressive(rng, 400), block=40, seed=seed)
            slopes.append(found.slope_interval[0] < 0.01 < found.slope_interval[1])
            middles.append(found.lower[200] < truth[200] < found.upper[200])
        assert 0.9 < np.mean(slopes) < 0.99
        assert 0.9 < np.mean(middles) < 0.99

    def test_blocks_of_one_frame_are_too_sure_of_correlated_values(self):
        values = autoregressive(np.random.default_rng(2), 2000, 0.95)
        width = [np.ptp(drift.trend(values, block=b).slope_interval) for b in (1, 200)]
        assert width[1] > 3 * width[0]

    def test_the_same_seed_gives_the_same_band(self):
        values = np.random.default_rng(3).normal(size=160)
        np.testing.assert_array_equal(drift.trend(values).lower, drift.trend(values).lower)

    def test_too_few_values_are_refused(self):
        with pytest.raises(ValueError, match=r"three blocks of 50 frames, got 149"):
            drift.trend(np.zeros(149))

    def test_what_is_not_finite_is_refused(self):
        with pytest.raises(ValueError, match="values must be finite"):
            drift.trend(np.append(np.zeros(200), np.nan))
