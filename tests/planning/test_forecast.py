"""The power law of errors."""

import pytest

from ast_sim.planning import forecast as module
from ast_sim.planning.forecast import forecast, slope


def test_the_slope_is_the_power_between_the_two_longest():
    points = [(10, 9.0), (30, 0.4 * 3**0.5), (90, 0.4)]
    assert slope(points) == pytest.approx(0.5)
    assert slope([(10, 0.3), (30, 0.9)]) == pytest.approx(-1)


def test_beyond_the_longest_the_slope_is_damped():
    expected = forecast([(30, 0.4 * 3**0.5), (90, 0.4)], 90 * 16)
    assert expected.error == pytest.approx(0.4 * 16 ** (-0.5 * module.DAMPING))
    assert [expected.low, expected.high] == pytest.approx([0.7 * expected.error, 1.3 * expected.error])


@pytest.mark.parametrize("longest", [0.3, 0.4])
def test_errors_that_do_not_fall_are_not_forecast(longest):
    assert forecast([(30, 0.3), (90, longest)], 1000) is None
