"""Which setting keeps an error and is the fastest, on both sides; who is ahead; when simulation and training pay."""

import math

import pytest

from ast_sim.trade_figures import Setting, Side, TradeFigures, front
from ast_sim.view import trade_page

SCENES = tuple(f"test/{index:06d}" for index in range(10))


def setting(name, error, seconds, failed=0):
    """A setting with errors of 0.1 to 1 times `error`, and `failed` scenes without an answer."""
    errors = [error * (k + 1) / 10 for k in range(10 - failed)] + [math.inf] * failed
    return Setting(name, tuple(errors), (seconds,) * (10 - failed) + (math.inf,) * failed)


def figures(**more):
    run = (setting("call", 0.08, 0.02), setting("Newton", 0.01, 0.04))
    solver = (setting("own", 0.0, 0.1), setting("coarse", 0.04, 0.05), setting("lucky", 0.001, 0.001, failed=2))
    return TradeFigures(SCENES, run, solver, **more)


def test_nine_of_ten_scenes_keep_an_error():
    assert setting("one", 0.1, 1.0).kept == pytest.approx(0.09)
    assert setting("one", 0.1, 1.0, failed=1).kept == pytest.approx(0.09)
    assert setting("one", 0.1, 1.0, failed=2).kept == math.inf
    assert Setting("few", (0.1, 0.2, 0.3), (1.0,) * 3).kept == 0.3


def test_a_mean_that_is_much_longer_than_the_median_is_told():
    errors = (0.0,) * 10
    assert Setting("even", errors, (0.1,) * 10).time == "100 ms"
    assert Setting("once", errors, (0.1,) * 9 + (0.5,)).time == "100 ms"  # the mean is 140 ms
    assert Setting("rare", errors, (0.1,) * 8 + (1.1, 2.1)).time == "100 ms (mean 400 ms)"
    assert Setting("none", (math.inf,) * 10, (math.inf,) * 10).time.startswith("inf")
    rare = Setting("rare", errors, (0.1,) * 9 + (2.1,))
    table = str(TradeFigures(SCENES, (rare,), (setting("own", 0.0, 0.5),)).lines())
    assert "the run: 100 ms (mean 300 ms) (rare)" in table


def test_at_each_error_the_fastest_setting_that_keeps_it_counts_on_both_sides():
    rows = {row.tolerance: row for row in figures().rows()}
    chosen = {
        tolerance: (row.run.name if row.run else None, row.solver.name if row.solver else None, row.verdict)
        for tolerance, row in rows.items()
    }
    assert chosen == {
        0.1: ("call", "coarse", "the run"),
        0.05: ("Newton", "coarse", "the run"),
        0.025: ("Newton", "own", "the run"),
        0.01: ("Newton", "own", "the run"),
        0.005: (None, "own", "the solver alone"),
        0.002: (None, "own", "the solver alone"),
    }
    assert rows[0.1].ratio == pytest.approx(2.5) == rows[0.1].low == rows[0.1].high
    assert rows[0.005].ratio is None


def test_the_interval_decides_who_is_faster():
    """Ratios of 0.5 to 2 are level; below 1 in all draws, the solver is ahead."""
    run = Setting("run", (0.0,) * 10, (1.0,) * 10)
    mixed = Setting("solver", (0.0,) * 10, (0.5,) * 5 + (2.0,) * 5)
    fast = Setting("solver", (0.0,) * 10, (0.5,) * 9 + (2.0,))
    (level, *_), (ahead, *_) = (TradeFigures(SCENES, (run,), (one,)).rows() for one in (mixed, fast))
    assert level.verdict == "level" and level.low == 0.5 and level.high == 2.0
    assert ahead.verdict == "the solver" and ahead.ratio == 0.5 and ahead.pays_after is None


def test_what_was_invested_is_repaid_by_the_time_that_each_answer_saves():
    rows = figures(invested=30.0).rows()
    assert [row.pays_after for row in rows] == [1000, 3000, 500, 500, None, None]
    assert all(row.pays_after is None for row in figures().rows())


def test_the_front_holds_what_nothing_beats():
    slow = setting("slow", 0.5, 1.0)
    assert [one.name for one in front([slow, *figures().solver])] == ["coarse", "own"]


def test_the_text_and_the_json_say_it():
    told = figures(no_solver="it was not made here", origin={"run": "r"})
    line = "10 %: the run: 20 ms (call); the solver: 50 ms (coarse); ratio 2.50 (2.50 to 2.50): the run"
    assert told.lines()[1] == line
    assert told.lines()[-1] == "The solver was not run: it was not made here"
    values = told.to_json()
    assert values["rows"][0]["solver"] == "coarse" and values["rows"][4]["run"] is None
    assert values["solver"][2]["errors"][-1] is None and values["origin"] == {"run": "r"}


def test_the_figures_are_read_back_from_their_json():
    known = figures(no_solver="no", invested=30.0, origin={"run": "r"})
    assert TradeFigures.from_json(known.to_json()) == known


def test_the_error_of_the_mesh_is_the_median_of_its_scenes():
    assert figures().mesh_error is None
    assert figures().mesh_line == ""
    known = figures(mesh_errors=(0.07, 0.02, 0.034))
    assert known.mesh_error == 0.034
    assert known.lines()[-1].startswith("The mesh alone makes the displacement 3.4 % wrong (median of 3 scenes, ")
    assert TradeFigures.from_json(known.to_json()) == known


def test_other_sides_stand_in_the_rows_with_their_fastest_setting():
    other = Side("mgn", (setting("one call", 0.02, 0.06), setting("two calls", 0.06, 0.03), setting("no", 0, 0.01, 2)))
    known = figures(others=(other, Side("none", ())))
    assert known.columns[:5] == ["error at most", "the run", "the solver", "mgn", "none"]
    rows = known.rows()
    names = [one and one.name for one in (row.others["mgn"] for row in rows)]
    assert names == ["two calls", "one call", "one call", None, None, None]
    assert rows[0].cells[1:6] == ["20 ms: call", "50 ms: coarse", "30 ms: two calls", "none", "2.50 (2.50 to 2.50)"]
    assert len(rows[0].cells) == len(known.columns)
    line = "10 %: the run: 20 ms (call); the solver: 50 ms (coarse); mgn: 30 ms (two calls); none"
    assert known.lines()[1].startswith(line)
    values = known.to_json()
    assert values["rows"][0]["others"] == {"mgn": "two calls", "none": None}
    assert values["others"][0]["settings"][2]["errors"][-1] is None
    assert TradeFigures.from_json(values) == known


@pytest.mark.parametrize("name", ["run", "the run", "solver", "the solver"])
def test_another_run_may_have_any_name(name):
    """Its figures stand beside the figures of the run and the solver, not in their place."""
    known = figures(others=(Side(name, (setting("slow call", 0.05, 0.04),)),))
    line = f"10 %: the run: 20 ms (call); the solver: 50 ms (coarse); {name}: 40 ms (slow call); ratio 2.50"
    assert known.lines()[1].startswith(line)
    rows = trade_page.page_data(known)["settings"]["rows"]
    both = [(side, row[1]) for side in ("the run", "the solver", name) for row in rows if row[0] == side]
    assert {("the run", "call"), ("the solver", "coarse"), (name, "slow call")} <= set(both)


def test_why_there_is_no_gaussian_process_is_told():
    known = figures(no_process="each scene has a mesh of its own")
    assert known.lines()[-1] == known.notes[-1] == "No Gaussian process: each scene has a mesh of its own"
    assert TradeFigures.from_json(known.to_json()) == known


def test_a_side_that_is_ahead_of_the_run_is_named():
    fast = Side("Gaussian process", (setting("40 scenes", 0.004, 0.001),))  # keeps 0.36 %, the run keeps 0.9 % at best
    mixed = Setting("one call", (0.0,) * 10, (0.01,) * 5 + (0.03,) * 5)  # level with the call of the run
    known = figures(others=(fast, Side("mgn", (mixed,))))
    assert known.ahead_of_run["Gaussian process"] == [0.1, 0.05, 0.025, 0.01, 0.005]
    assert known.ahead_of_run["mgn"] == [0.05, 0.025, 0.01, 0.005, 0.002]
    assert known.notes[0] == "Gaussian process is ahead of the run at 10 % and 5 % and 2.5 % and 1 % and 0.5 %"
    assert known.notes[0] in known.lines() and figures().notes == []


def test_a_scene_that_neither_answers_speaks_for_nobody():
    slow, fast = (Side(name, (setting(name, 0.01, seconds, 1),)) for name, seconds in (("slow", 0.2), ("fast", 0.01)))
    known = TradeFigures(SCENES, (setting("run", 0.01, 0.1, 1),), (), others=(slow, fast))
    assert known.ahead_of_run == {"fast": [0.1, 0.05, 0.025, 0.01]}


@pytest.mark.parametrize(("scenes", "told"), [(1, "1 scene is too few"), (5, "5 scenes are too few"), (6, "")])
def test_few_scenes_are_told(scenes, told):
    """One scene had a ratio of 49.96 (49.96 to 49.96). The true median lies beyond all of n ratios in 2 of 2**n cases:
    in 6 % with 5 scenes, in 3 % with 6."""
    run, solver = (Setting(name, (0.01,) * scenes, (time,) * scenes) for name, time in (("call", 1.0), ("own", 2.0)))
    few = TradeFigures(SCENES[:scenes], (run,), (solver,))
    notes = [note for note in few.notes if "too few" in note]
    assert [note.split(":")[0] for note in notes] == ([told] if told else [])
    assert all(note in few.lines() for note in notes)
