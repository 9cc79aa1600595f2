import numpy as np
import pytest

from avatarjax.metrics import checks


def test_what_fits_comes_back_as_float64():
    found = checks.finite("values", [[1, 2], [3, 4]], (None, 2))
    np.testing.assert_array_equal(found, [[1.0, 2.0], [3.0, 4.0]])
    assert found.dtype == np.float64


def test_without_a_dtype_nothing_is_copied():
    values = np.ones((3, 2), np.float32)
    assert checks.finite("values", values, (3, None), None) is values


@pytest.mark.parametrize("values", [np.ones(3), np.ones((3, 1)), np.ones((0, 2)), np.ones((1, 3, 2))])
def test_another_shape_is_refused_with_both(values):
    with pytest.raises(ValueError) as refused:
        checks.finite("values", values, (None, 2))
    assert "(any, 2)" in str(refused.value) and str(values.shape) in str(refused.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_first_number_that_is_not_finite_is_named(bad):
    values = np.ones((3, 2))
    values[1:, 1] = bad
    with pytest.raises(ValueError, match=r"2 of 6 numbers are not finite, the first at \(1, 1\)"):
        checks.finite("values", values, (None, 2))


@pytest.mark.parametrize("value", [0.0, 1.0, -0.1, 95.0, float("nan")])
def test_fractions_lie_strictly_between_0_and_1(value):
    with pytest.raises(ValueError, match="confidence must lie between 0 and 1"):
        checks.fraction("confidence", value)
    assert checks.fraction("confidence", 0.5) == 0.5
