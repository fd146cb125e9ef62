"""The effort that a wanted error chooses: ranks, nested misses, and how often a promise is broken."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from ast_sim.inference.effort import Effort
from ast_sim.inference.promises.chosen_effort import parse_error
from ast_sim.inference.promises.kept_errors import KeptErrors
from ast_sim.support.errors import ConfigError

EFFORTS = (Effort(), Effort(0, 1), Effort(0, 10))


def of(*rows, **others):
    """The errors of the displacement, a row for each effort, and of other quantities."""
    quantities = {"displacement": rows, **others}
    return KeptErrors(EFFORTS[: len(rows)], {q: tuple(map(tuple, each)) for q, each in quantities.items()})


def test_of_19_scenes_one_may_miss_and_of_9_none():
    errors = [0.01 * k for k in range(1, 20)]  # (19 + 1) / 10 = 2 = 1 + 1
    assert of(errors).effort_for({"displacement": 0.18}) == Effort()
    with pytest.raises(ConfigError, match="17.9 % of the displacement in 90 % of the scenes; the smallest is .* 18 %"):
        of(errors).effort_for({"displacement": 0.179})
    assert of(errors).bounds("displacement") == [pytest.approx(0.18)]
    assert of(errors[:9]).effort_for({"displacement": 0.09}) == Effort()
    with pytest.raises(ConfigError, match="smallest is displacement 9 %, with 0 corrections"):
        of(errors[:9]).effort_for({"displacement": 0.089})


def test_the_cheapest_effort_that_keeps_the_error_is_chosen():
    known = of([0.08] * 9, [0.03] * 9, [0.01] * 9)
    cheapest = {0.08: Effort(), 0.05: Effort(0, 1), 0.01: Effort(0, 10)}
    assert {error: known.effort_for({"displacement": error}) for error in cheapest} == cheapest


def test_a_scene_that_a_dearer_effort_spoils_misses_the_cheaper_one_too():
    """Without this the misses are not nested, and the promise holds for no reason."""
    known = of([0.02] * 9, [0.01] * 8 + [math.inf], [0.01] * 9)
    assert known.bounds("displacement") == [math.inf, math.inf, 0.01]
    assert known.effort_for({"displacement": 0.05}) == Effort(0, 10)


def test_several_quantities_are_kept_in_the_same_scenes():
    reaction = [[0.01] * 9, [0.01] * 9]
    known = of([0.08] * 9, [0.03] * 9, reaction=reaction)
    assert known.effort_for({"displacement": 0.05, "reaction": 0.01}) == Effort(0, 1)
    with pytest.raises(
        ConfigError, match="are, each alone, displacement 3 %, reaction 1 %, with 0 corrections, up to 1"
    ):
        known.effort_for({"displacement": 0.02, "reaction": 0.01})
    errors = [0.01] * 18 + [1.0]
    once = of(errors, reaction=[errors[::-1]])  # one scene misses each, but not the same
    assert once.effort_for({"reaction": 0.01}) == Effort()
    with pytest.raises(ConfigError, match="no effort"):
        once.effort_for({"displacement": 0.01, "reaction": 0.01})


def test_what_cannot_be_asked_is_refused():
    known = of([0.01] * 9)
    with pytest.raises(ConfigError, match="an error of stress is not known; known are displacement"):
        known.effort_for({"stress": 0.1})
    for error in (0, 2, math.nan):
        with pytest.raises(ConfigError, match="between 0 and 1, as 0.02 for 2 %"):
            known.effort_for({"displacement": error})
    with pytest.raises(ConfigError, match="calibrate it again"):
        KeptErrors().effort_for({"displacement": 0.1})


@pytest.mark.parametrize("nested", [False, True])
def test_a_promise_is_broken_in_at_most_a_tenth_of_fresh_scenes_and_not_far_less(nested):
    """92 % of the scenes keep the wanted error after the first of three efforts, which are equal, or ever better."""
    rng = np.random.default_rng(6)
    shares = np.array([[1.0], [0.5], [0.3]])
    limit = 0.1 * float(np.exp(0.5 * norm.ppf(0.92)))
    broken = 0

    def drawn(scenes):
        return 0.1 * (shares if nested else 1) * rng.lognormal(0, 0.5, size=(1 if nested else 3, scenes))

    for _ in range(1500):
        known = of(*drawn(50).tolist())
        try:
            effort = known.effort_for({"displacement": limit})
        except ConfigError:
            continue
        broken += drawn(1)[EFFORTS.index(effort), 0] > limit
    assert 0.03 <= broken / 1500 <= 0.1


def test_the_errors_are_kept_in_json():
    known = of([0.1, math.inf], [0.2, 0.3])
    assert KeptErrors.from_json(known.to_json()) == known
    assert known.to_json()["errors"]["displacement"] == [[0.1, None], [0.2, 0.3]]


def test_an_error_is_read_as_a_share_or_in_percent():
    for text, expected in {"2%": 0.02, "0.02": 0.02, "2 %": 0.02, "displacement=2%": 0.02}.items():
        assert parse_error(text) == ("displacement", expected)
    assert parse_error("reaction=5%") == ("reaction", 0.05)
    for text in ("", "two", "reaction=", "5%=reaction"):
        with pytest.raises(ConfigError, match="give one such as 2%, 0.02 or reaction=5%"):
            parse_error(text)
