"""Expressions and drawn values: arithmetic, ranges, even filling, the same values for the same seed and number."""

import math

import numpy as np
import pytest

from ast_sim.simulate.own_assembly.expressions import expression
from ast_sim.simulate.own_assembly.parameters import Parameter, completed, drawn, parameter, told
from ast_sim.support.errors import ConfigError

PARAMETERS = {
    "travel": parameter("travel", [2, 6]),
    "wall": parameter("wall", 1.5),
    "pad.young": parameter("pad.young", {"low": 1e5, "high": 1e7, "log": True}),
    "pad.file": Parameter("pad.file", choices=("a.step", "b.step", "c.step")),
    "hook.young": parameter("hook.young", "2 * wall", {"wall": parameter("wall", 1.5)}),
}


@pytest.mark.parametrize(
    ("text", "value"),
    [("-a", -2), ("a + 3*b", 17), ("(a - b) / 2", -1.5), ("a**b", 32), ("b*sin(30)", 2.5), ("max(a, b, 7)", 7),
     ("sqrt(4*a + 1) - abs(-1)", 2), (3, 3), ("tan(45)", 1)],
)  # fmt: skip
def test_arithmetic(text, value):
    assert expression("key", text, ["a", "b"])({"a": 2.0, "b": 5.0}) == pytest.approx(value)


@pytest.mark.parametrize("text", ["a.b", "[a]", "a if a else b", "'a'", "a < b", "lambda: a", "sin(x=a)", "a;b", "",
                                  "True", "sin", "a + min", "max(sin, 1)", "a=3", "'a'*9", "f'{a:9999999d}'", "b'1'",
                                  "__import__('os')", "a" * 300, "(" * 150 + ")" * 150, "a // b", "sin()"])  # fmt: skip
def test_nothing_but_arithmetic(text):
    with pytest.raises(ConfigError, match="key = "):
        expression("key", text, ["a", "b"])


def test_results_are_finite_numbers():
    for value in ("1/0", "1e308*10", "(-8)**0.5", "9**9**9", "0*9**9**9**9", "1e999", "sqrt(-1)",
                  math.inf, -math.inf, math.nan, 10**400):  # fmt: skip
        with pytest.raises(ConfigError, match="key (=|is) "):
            expression("key", value, [])
    with pytest.raises(ConfigError, match="cannot be computed"):
        expression("key", "a**a**a", ["a"])({"a": 9})


def test_values_follow_from_seed_split_and_number():
    values = drawn(PARAMETERS, 3, 1, 17)
    assert values == drawn(PARAMETERS, 3, 1, 17)
    others = [drawn(PARAMETERS, *sample) for sample in ((4, 1, 17), (3, 0, 17), (3, 1, 18), (3, 1, 17, 1))]
    assert all(other["travel"] != values["travel"] for other in others)
    assert list(values) == list(PARAMETERS) and values["wall"] == 1.5 and values["hook.young"] == 3.0


def test_ranges_are_filled_evenly():
    """The first 64 points of a Sobol sequence have one value in each 64th of every range."""
    values = [drawn(PARAMETERS, 0, 0, index) for index in range(64)]
    travel = np.sort([(v["travel"] - 2) / 4 for v in values])
    young = np.sort([math.log(v["pad.young"] / 1e5) / math.log(100) for v in values])
    for shares in (travel, young):
        assert np.array_equal(np.floor(64 * shares), np.arange(64))
    files = [v["pad.file"] for v in values]
    assert {files.count(name) for name in PARAMETERS["pad.file"].choices} <= {20, 21, 22, 23}


def test_given_values_take_the_place_of_the_middle():
    values = completed(PARAMETERS, {"travel": 9, "young": {"pad": 2e6}, "pad.file": "b.step"})
    assert values == {"travel": 9.0, "wall": 1.5, "pad.young": 2e6, "pad.file": "b.step", "hook.young": 3.0}
    assert completed(PARAMETERS, {})["pad.young"] == pytest.approx(1e6)
    assert completed(PARAMETERS, {"wall": 2.0})["hook.young"] == 4.0
    assert told(PARAMETERS, values) == "travel=9, pad.young=2e+06, pad.file=b.step"
    for given, line in (
        ({"travl": 1}, "there is no parameter 'travl'; did you mean 'travel'"),
        ({"young": {"pat": 1}}, "there is no parameter 'pat.young'; did you mean 'pad.young'"),
        ({"travel": "far"}, "travel is 'far'; must be a finite number"),
        ({"pad.file": "d.step"}, "pad.file is 'd.step'; must be one of a.step, b.step, c.step"),
    ):
        with pytest.raises(ConfigError, match=line):
            completed(PARAMETERS, given)
