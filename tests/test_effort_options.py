"""The options of `predict` and `sweep` that choose an effort are the numbers of `Effort`."""

from dataclasses import replace

import pytest

from ast_sim import Effort
from ast_sim.cli import build_parser
from ast_sim.command_line.effort_options import effort_of
from ast_sim.inference.effort import MOST_NEWTON_STEPS, EffortErrors, error_with, options_of
from ast_sim.support.errors import ConfigError

DEFAULT = Effort(3, 10)
PREDICT = ("predict", "run", "scene.vtu", "--out", "answer.h5")
SWEEP = ("sweep", "run", "SPEC.toml", "--out", "forces.csv")


def parsed(*options: str, command: tuple[str, ...] = PREDICT) -> Effort | None:
    return effort_of(build_parser().parse_args([*command, *options]), DEFAULT)


@pytest.mark.parametrize("command", [PREDICT, SWEEP])
def test_options_change_the_default_effort(command):
    assert parsed(command=command) is None
    assert parsed("--corrections", "1", command=command) == Effort(1, 0)  # no Newton steps where none are asked for
    assert parsed("--newton-steps", "2", command=command) == Effort(3, 2)
    assert parsed("--exact", command=command) == Effort.exact()
    partly = Effort(3, MOST_NEWTON_STEPS, solved=True, solved_beyond=0.1)
    assert parsed("--solved-beyond", "0.1", command=command) == partly
    assert parsed("--solved-beyond", "0.1", "--newton-steps", "2", command=command) == replace(partly, newton_steps=2)


def test_a_precision_changes_nothing_else_of_the_default():
    assert parsed("--precision", "bfloat16") == Effort(3, 10, precision="bfloat16")
    assert parsed("--precision", "bfloat16", "--corrections", "1") == Effort(1, 0, precision="bfloat16")
    assert parsed("--exact", "--precision", "bfloat16") == replace(Effort.exact(), precision="bfloat16")
    with pytest.raises(ConfigError, match="precision is 'half': choose of float32, bfloat16"):
        Effort(precision="half")


def test_an_exact_answer_takes_no_numbers():
    with pytest.raises(ConfigError, match="needs no numbers: leave --newton-steps out"):
        parsed("--exact", "--newton-steps", "1")
    with pytest.raises(ConfigError, match="needs no numbers: leave --solved-beyond out"):
        parsed("--exact", "--solved-beyond", "0.1")


@pytest.mark.parametrize(
    "effort",
    [
        Effort(),
        Effort(2, 0),
        Effort(0, 10),
        Effort.exact(),
        Effort(1, 10, solved=True, solved_beyond=0.075),
        Effort(1, 2, precision="bfloat16"),
        replace(Effort.exact(), precision="bfloat16"),
    ],
)
def test_the_options_of_an_effort_ask_for_it(effort):
    assert parsed(*options_of(effort)) == effort


def test_an_effort_has_the_error_of_the_most_newton_steps_that_were_measured():
    measured = [EffortErrors(Effort(c, steps), 10 * c + steps, None, steps, 0) for c in (0, 1) for steps in range(3)]
    assert error_with(Effort(1, 1), measured) == 11
    assert error_with(Effort(1, 9), measured) == 12
    assert error_with(Effort(2, 1), measured) is None
    assert error_with(Effort.exact(), measured) is None
    assert error_with(Effort(), []) is None
