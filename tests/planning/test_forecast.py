"""The power law of errors."""

import pytest

from ast_sim.planning import forecast as module
from ast_sim.planning.forecast import forecast, slope


def test_the_slope_is_the_power_between_the_two_longest():
    points = [(10, 9.0), (30, 0.4 * 3**0.5), (90, 0.4)]
    assert slope(points) == pytest.approx(0.5)
    assert slope([(10, 0.3), (30, 0.4)]) == 0


def test_beyond_the_longest_the_slope_is_damped():
    expected = forecast([(30, 0.4 * 3**0.5), (90, 0.4)], 90 * 16)
    assert expected.error == pytest.approx(0.4 * 16 ** (-0.5 * module.DAMPING))
    assert expected.low < expected.error < expected.high <= 1.3 * expected.error
    assert expected.low >= expected.error / 1.3


def test_errors_that_do_not_fall_are_expected_to_stay():
    assert forecast([(30, 0.3), (90, 0.4)], 1000).error == 0.4
