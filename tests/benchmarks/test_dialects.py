"""Some draws of the dialects; and that the comparison sees what differs."""

import dataclasses
import warnings

import numpy as np
import pytest

from benchmarks.robustness.dialects import comparison
from benchmarks.robustness.dialects.__main__ import measure, outcome
from benchmarks.robustness.dialects.draws import DIALECTS, draw
from benchmarks.robustness.dialects.told import told_of_order

DRAWS = 39  # each dialect three times
EXODUS = "Exodus and VTKHDF of VTK"


def test_random_files_of_many_programs_are_read_right_or_refused(tmp_path):
    result = measure(DRAWS, 0, tmp_path)
    assert result["bad"] == []
    assert set(result["by dialect"]) == set(DIALECTS)
    # One of these draws is a legacy file on which VTK crashes; nothing else is refused.
    others = [text for text in result["refusals"] if "VTK crashed on it" not in text]
    assert result["outcomes"]["right"] >= DRAWS - 1 and others == []


def moved(simulation):
    simulation.bodies[0].points[0] += 0.01 * simulation.size


def another_order_of_frames(simulation):
    simulation.displacement = simulation.displacement[::-1]


def one_mark_less(simulation):
    simulation.fixed = simulation.fixed & (np.arange(len(simulation.fixed)) != np.flatnonzero(simulation.fixed)[0])


def other_stress(simulation):
    simulation.stress = simulation.stress + 0.01 * simulation.stress.max()


def other_times(simulation):
    simulation.times = simulation.times + 0.01


def one_cell_less(simulation):
    kind, cells = simulation.bodies[0].blocks[0]
    simulation.bodies[0].blocks[0] = (kind, cells[1:])


def a_defect_that_was_not_told(simulation):
    simulation.defects = {"twice"}


@pytest.mark.parametrize(
    "change",
    [
        moved,
        another_order_of_frames,
        one_mark_less,
        other_stress,
        other_times,
        one_cell_less,
        a_defect_that_was_not_told,
    ],
)
def test_the_comparison_sees_what_differs(tmp_path, change):
    """The simulation is changed after its file is written, so what is read differs from it."""
    seed = next(seed for seed in range(50) if "twice" not in draw(EXODUS, seed, tmp_path)[0].defects)
    simulation, case = draw(EXODUS, seed, tmp_path)
    assert outcome(case, simulation) == ("right", "")
    change(simulation)
    assert outcome(case, simulation)[0] == "silent"


def with_middles(simulation):
    """The points of a body of tetrahedra of ten nodes, and its cells."""
    return next((body, cells) for body in simulation.bodies for kind, cells in body.blocks if kind == "tetra10")


def middle_of(simulation):
    """The number of a middle among all points."""
    return next(cells[0, 4] for _, kind, cells in simulation.blocks if kind == "tetra10")


def middle_moved(simulation):
    body, cells = with_middles(simulation)
    body.points[cells[0, 4]] += 0.001 * simulation.size


def middle_with_another_way(simulation):
    simulation.displacement[-1, middle_of(simulation)] += 0.01 * simulation.size


def middle_with_another_mark(simulation):
    simulation.fixed = simulation.fixed ^ (np.arange(len(simulation.fixed)) == middle_of(simulation))


def middle_with_another_stress(simulation):
    simulation.stress[-1, middle_of(simulation)] += 0.1 * simulation.stress.max()


def middles_of_other_edges(simulation):
    _, cells = with_middles(simulation)
    cells[:, 4:6] = cells[:, 5:3:-1]


@pytest.fixture(scope="module")
def ten_nodes(tmp_path_factory):
    """The folder and the seed of a draw whose deforming body, the first one, has tetrahedra of ten nodes."""
    for seed in range(200):
        folder = tmp_path_factory.mktemp("ten")
        simulation, _ = draw(EXODUS, seed, folder)
        if simulation.ten_nodes and simulation.bodies[0].blocks[0][0] == "tetra10":
            return folder, seed
    raise AssertionError("no draw has such a body")


@pytest.mark.parametrize(
    "change",
    [
        middle_moved,
        middle_with_another_way,
        middle_with_another_mark,
        middle_with_another_stress,
        middles_of_other_edges,
    ],
)
def test_the_comparison_sees_what_differs_at_the_middles_of_edges(ten_nodes, change):
    folder, seed = ten_nodes
    simulation, case = draw(EXODUS, seed, folder)
    assert outcome(case, simulation) == ("right", "")
    change(simulation)
    assert outcome(case, simulation)[0] == "silent"


def test_a_group_without_a_middle_is_seen(tmp_path):
    for seed in range(200):
        (tmp_path / str(seed)).mkdir()
        simulation, case = draw("decks, too", seed, tmp_path / str(seed))
        if simulation.ten_nodes and case.groups:
            break
    assert outcome(case, simulation) == ("right", "")
    middles = [cells[:, 4:] for _, kind, cells in simulation.blocks if kind == "tetra10"]
    name, nodes = next((name, one) for name, one in case.groups.items() if np.isin(one, middles[0]).any())
    wrong = dataclasses.replace(case, groups={name: np.setdiff1d(nodes, nodes[np.isin(nodes, middles[0])][:1])})
    assert outcome(wrong, simulation)[0] == "silent"


def test_what_is_told_without_a_reason_is_seen(tmp_path, monkeypatch):
    def fits(simulation):
        return "twice" in simulation.defects and not any(kind[-1].isdigit() for kind in simulation.kinds)

    seed = next(seed for seed in range(200) if fits(draw(EXODUS, seed, tmp_path)[0]))
    simulation, case = draw(EXODUS, seed, tmp_path)
    assert outcome(case, simulation) == ("right", "")
    simulation.defects.discard("twice")
    ended, text = outcome(case, simulation)
    assert ended == "silent" and "without a reason it is said: " in text and "taken once" in text
    simulation.defects.add("twice")
    monkeypatch.setattr(comparison, "in_trajectory", lambda trajectory: ["elements that turn over"])
    assert outcome(case, simulation) == ("silent", "without a reason it is warned: elements that turn over")
    monkeypatch.setattr(comparison, "in_trajectory", lambda trajectory: warnings.warn("rounded", stacklevel=1) or [])
    assert outcome(case, simulation) == ("silent", "without a reason it is warned: rounded")


@pytest.mark.parametrize(
    ("names", "by_times", "told"),
    [
        (["f9.vtu", "f10.vtu"], False, False),
        (["a-0.5.vtu", "a-0.25.vtu"], False, False),
        (["a-0.25.vtu", "a-0.3.vtu"], False, True),
        (["k7.vtu", "b.vtu"], True, True),
        (["b.vtu", "u.vtu"], True, False),
    ],
)
def test_the_note_on_the_order_of_files_comes_where_it_has_a_reason(names, by_times, told):
    assert bool(told_of_order(names, by_times)) == told


def test_a_missing_group_is_seen(tmp_path):
    simulation, case = draw("Gmsh", 8, tmp_path)
    assert case.groups
    name, nodes = next(iter(case.groups.items()))
    corner = simulation.corners[np.isin(simulation.corners, nodes)]
    wrong = dataclasses.replace(case, groups={name: np.setdiff1d(nodes, corner[:1])})
    assert outcome(wrong, simulation)[0] == "silent"
    assert outcome(dataclasses.replace(case, groups={"none of this name": nodes}), simulation)[0] == "silent"
