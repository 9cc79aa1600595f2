import math

import numpy as np
import pytest
import scipy.stats

from avatarjax.metrics.statistics import Estimate, bootstrap, expanded_tails, paired_t_test


class TestEstimate:
    def test_it_reads_as_a_mean_and_its_interval(self):
        found = Estimate(12.42, 11.84, 13.06, 30)
        assert f"{found:.1f}" == "12.4 [11.8, 13.1]"
        assert str(found) == "12.42 [11.84, 13.06]"

    def test_without_an_interval_it_says_of_how_many(self):
        assert f"{bootstrap([3.0]):.1f}" == "3.0 (n = 1)"
        assert f"{bootstrap([3.0, 4.0], [0, 0]):.1f}" == "3.5 (n = 2 in 1)"


class TestBootstrap:
    def test_the_mean_is_the_mean_of_all_values(self):
        values = np.random.default_rng(0).normal(size=(4, 5))
        assert bootstrap(values).mean == pytest.approx(values.mean())
        assert bootstrap(values).n == 20

    def test_it_nears_the_normal_interval(self):
        values = np.random.default_rng(1).normal(size=400)
        half = 1.96 * values.std(ddof=1) / 20
        found = bootstrap(values)
        np.testing.assert_allclose([found.low, found.high], values.mean() + np.array([-half, half]), atol=0.1 * half)

    def test_it_covers_the_truth_as_often_as_it_says(self):
        rng = np.random.default_rng(2)
        found = [bootstrap(rng.exponential(size=40), seed=k) for k in range(200)]
        covered = np.mean([e.low < 1 < e.high for e in found])
        assert 0.88 < covered < 0.99

    def test_groups_cover_the_truth_of_correlated_values_and_single_values_do_not(self):
        rng = np.random.default_rng(3)
        labels = np.repeat(np.arange(20), 30)
        covered = []
        for seed in range(200):
            values = rng.normal(size=20)[labels] + 0.2 * rng.normal(size=600)
            grouped, single = bootstrap(values, labels, seed=seed), bootstrap(values, seed=seed)
            covered.append((grouped.low < 0 < grouped.high, single.low < 0 < single.high))
        share = np.mean(covered, axis=0)
        assert 0.9 < share[0] < 0.99
        assert share[1] < 0.5

    def test_groups_of_one_are_single_values(self):
        values = np.random.default_rng(4).normal(size=200)
        grouped, single = bootstrap(values, np.arange(200)), bootstrap(values)
        np.testing.assert_allclose(grouped[:3], single[:3], atol=0.03)
        assert (grouped.n, grouped.groups) == (200, 200)

    def test_groups_of_different_sizes_count_by_their_size(self):
        assert bootstrap([0.0, 0.0, 0.0, 1.0], ["a", "a", "a", "b"]).mean == 0.25

    @pytest.mark.parametrize("count", [3, 10, 1000])
    def test_expanded_tails_make_means_of_normal_values_as_wide_as_students(self, count):
        low, high = expanded_tails(0.95, count)
        plain = scipy.stats.norm.ppf(high / 100) * np.sqrt((count - 1) / count)
        assert plain == pytest.approx(scipy.stats.t.ppf(0.975, count - 1), rel=1e-4)
        assert low == pytest.approx(100 - high)

    def test_equal_values_have_no_width(self):
        assert bootstrap(np.full(5, 2.5)) == Estimate(2.5, 2.5, 2.5, 5)

    def test_one_value_or_one_group_has_no_interval(self):
        for found in (bootstrap([1.0]), bootstrap([1.0, 2.0], [7, 7])):
            assert math.isnan(found.low) and math.isnan(found.high)

    def test_the_same_seed_gives_the_same_bounds(self):
        values = np.arange(30.0) ** 2
        assert bootstrap(values, seed=3) == bootstrap(values, seed=3)

    @pytest.mark.parametrize(
        "arguments, message",
        [
            (([1.0, np.nan],), r"values must be finite.*first at \(1\)"),
            (([],), "shape"),
            (([1.0, 2.0], [0]), "2 values, 1 labels"),
        ],
    )
    def test_nonsense_is_refused(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            bootstrap(*arguments)

    def test_a_confidence_in_percent_is_refused(self):
        with pytest.raises(ValueError, match=r"between 0 and 1, got 95\.0"):
            bootstrap([1.0, 2.0], confidence=95.0)


@pytest.fixture(scope="module")
def pairs():
    rng = np.random.default_rng(5)
    a = rng.normal(size=12)
    return a, a + 0.3 + 0.5 * rng.normal(size=12)


class TestPairedTest:
    def test_it_is_the_closed_form(self, pairs):
        difference = pairs[0] - pairs[1]
        error = difference.std(ddof=1) / np.sqrt(12)
        found = paired_t_test(*pairs)
        assert found.t == pytest.approx(difference.mean() / error)
        assert found.p == pytest.approx(2 * scipy.stats.t.sf(abs(found.t), 11))
        assert found.degrees == 11 and found.difference.n == 12
        half = scipy.stats.t.ppf(0.975, 11) * error
        np.testing.assert_allclose(found.difference[:3], difference.mean() + np.array([0, -half, half]))

    def test_exchanging_the_methods_only_turns_the_sign(self, pairs):
        there, back = paired_t_test(*pairs), paired_t_test(*pairs[::-1])
        assert there.p == pytest.approx(back.p) and there.t == pytest.approx(-back.t)

    def test_equal_differences_are_judged_without_warnings(self):
        assert paired_t_test(np.ones(4), np.ones(4))[:3] == (0.0, 1.0, 3)
        assert paired_t_test(np.zeros(4), np.ones(4))[:3] == (-math.inf, 0.0, 3)

    def test_one_pair_says_nothing(self):
        assert np.isnan(paired_t_test(np.ones(1), np.zeros(1))[:2]).all()

    def test_other_numbers_of_values_are_refused(self):
        with pytest.raises(ValueError, match=r"b must have the shape \(3\).*\(2,\)"):
            paired_t_test(np.ones(3), np.ones(2))

    def test_what_is_not_finite_is_refused(self):
        with pytest.raises(ValueError, match="a must be finite"):
            paired_t_test(np.array([1.0, np.inf]), np.ones(2))
