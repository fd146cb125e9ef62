"""Numbers as texts for people."""

import math

import pytest

from ast_sim.number_arrays import measured_time, percent
from ast_sim.support.errors import counted


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [
        (0.996, 2, "100 %"),
        (12.34, 2, "1200 %"),
        (12345.0, 3, "1230000 %"),
        (0.01234, 3, "1.23 %"),
        (0.05, 2, "5 %"),
        (1.5e-9, 2, "0.00000015 %"),
        (0.0, 2, "0 %"),
        (math.inf, 2, "inf %"),
        (math.nan, 2, "nan %"),
    ],
)
def test_a_share_in_percent_has_no_exponent(share, digits, text):
    assert percent(share, digits) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.02834, "28.3 ms"),
        (1e-7, "0.0001 ms"),
        (0.9994, "999 ms"),
        (0.9996, "1 s"),
        (1.7749, "1.77 s"),
        (12345.0, "12300 s"),
        (math.nan, "nan s"),
    ],
)
def test_a_time_has_no_exponent(seconds, text):
    assert measured_time(seconds) == text


def test_one_thing_is_counted_in_the_singular():
    assert [counted(n, "node") for n in (0, 1, 2, 1234)] == ["0 nodes", "1 node", "2 nodes", "1,234 nodes"]
    assert [counted(n, "element is", "elements are") for n in (1, 2)] == ["1 element is", "2 elements are"]
