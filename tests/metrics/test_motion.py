import numpy as np
import pytest

from avatarjax.metrics import motion


@pytest.fixture(scope="module")
def joints():
    rng = np.random.default_rng(0)
    return rng.normal(size=(9, 5, 3)), rng.normal(size=(9, 5, 3))


def test_the_error_is_the_printed_formula(joints):
    predicted, truth = joints
    expected = []
    for t in range(1, 8):
        a = [x[t + 1] - 2 * x[t] + x[t - 1] for x in (predicted, truth)]
        expected.append(np.sqrt(((a[0] - a[1]) ** 2).sum()))
    np.testing.assert_allclose(motion.acceleration_errors(predicted, truth), expected)
    assert motion.motion_error(predicted, truth) == pytest.approx(np.mean(expected))


def test_kanazawas_error_is_the_mean_of_each_joints_norm(joints):
    a, b = (np.diff(x, n=2, axis=0) for x in joints)
    np.testing.assert_allclose(motion.joint_acceleration_errors(*joints), np.linalg.norm(a - b, axis=-1).mean(1))


def test_of_one_joint_both_are_the_same(joints):
    one = [x[:, :1] for x in joints]
    np.testing.assert_allclose(motion.acceleration_errors(*one), motion.joint_acceleration_errors(*one))


@pytest.mark.parametrize("error", [motion.acceleration_errors, motion.joint_acceleration_errors])
def test_a_steady_movement_added_to_the_truth_is_no_error(joints, error):
    truth = joints[1]
    drifting = truth + np.array([1.0, 2.0, 3.0]) + 0.1 * np.arange(9.0)[:, None, None]
    np.testing.assert_allclose(error(drifting, truth), 0, atol=1e-12)


def test_accelerations_are_errors_against_rest():
    path = np.arange(6.0)[:, None, None] ** 2 * np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(motion.accelerations(path), 2.0)


def test_one_jerk_is_found_where_it_is():
    path = np.zeros((40, 3, 3)) + 0.01 * np.sin(np.arange(40.0))[:, None, None]
    calm = motion.accelerations(path)
    path[20] += 0.5
    found = motion.spikes(motion.accelerations(path), motion.spike_threshold(calm))
    np.testing.assert_array_equal(np.flatnonzero(found) + 1, [19, 20, 21])


def test_the_threshold_is_three_deviations_of_normal_errors():
    errors = np.random.default_rng(1).normal(5.0, 2.0, 100_000)
    assert motion.spike_threshold(errors) == pytest.approx(11.0, abs=0.1)
    assert motion.spikes(errors, motion.spike_threshold(errors)).mean() == pytest.approx(0.00135, abs=5e-4)


def test_too_few_frames_are_refused(joints):
    with pytest.raises(ValueError, match="three frames, got 2"):
        motion.acceleration_errors(joints[0][:2], joints[1][:2])


def test_other_skeletons_are_refused(joints):
    with pytest.raises(ValueError, match=r"predicted must have the shape \(9, 5, 3\).*\(9, 4, 3\)"):
        motion.acceleration_errors(joints[0][:, :4], joints[1])


def test_what_is_not_finite_is_refused(joints):
    broken = joints[0].copy()
    broken[4, 2, 0] = np.nan
    with pytest.raises(ValueError, match=r"predicted must be finite.*\(4, 2, 0\)"):
        motion.acceleration_errors(broken, joints[1])
    with pytest.raises(ValueError, match="reference_errors must be finite"):
        motion.spike_threshold(np.array([np.nan, 1.0]))
    with pytest.raises(ValueError, match="threshold must be finite"):
        motion.spikes(np.ones(3), float("nan"))


def test_a_known_window_is_fully_like_itself_whatever_its_size():
    known = np.random.default_rng(1).normal(size=(20, 12)) + 5
    mean = known.mean(0)
    windows = mean + np.array([[1.0], [0.3], [4.0]]) * (known[[2, 7, 11]] - mean)
    np.testing.assert_allclose(motion.nearest_correlation(windows, known), 1.0)


def test_likeness_is_the_highest_correlation():
    rng = np.random.default_rng(2)
    known, windows = rng.normal(size=(30, 8)), rng.normal(size=(4, 8))
    about = known.mean(0)
    cosines = [
        [np.dot(w - about, k - about) / np.linalg.norm(w - about) / np.linalg.norm(k - about) for k in known]
        for w in windows
    ]
    np.testing.assert_allclose(motion.nearest_correlation(windows, known), np.max(cosines, axis=1))


def test_the_mean_is_like_nothing():
    known = np.random.default_rng(3).normal(size=(5, 3))
    assert motion.nearest_correlation(known.mean(0)[None], known)[0] == pytest.approx(0, abs=1e-12)
