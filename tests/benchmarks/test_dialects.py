"""Some draws of the dialects; and that the comparison sees what differs."""

import dataclasses

import numpy as np
import pytest

from benchmarks.robustness.dialects.__main__ import measure, outcome
from benchmarks.robustness.dialects.draws import DIALECTS, draw

DRAWS = 39  # each dialect three times


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
    name = "Exodus and VTKHDF of VTK"
    seed = next(seed for seed in range(50) if "twice" not in draw(name, seed, tmp_path)[0].defects)
    simulation, case = draw(name, seed, tmp_path)
    assert outcome(case, simulation) == ("right", "")
    change(simulation)
    assert outcome(case, simulation)[0] == "silent"


def test_a_missing_group_is_seen(tmp_path):
    simulation, case = draw("Gmsh", 8, tmp_path)
    assert case.groups
    name, nodes = next(iter(case.groups.items()))
    corner = simulation.corners[np.isin(simulation.corners, nodes)]
    wrong = dataclasses.replace(case, groups={name: np.setdiff1d(nodes, corner[:1])})
    assert outcome(wrong, simulation)[0] == "silent"
    assert outcome(dataclasses.replace(case, groups={"none of this name": nodes}), simulation)[0] == "silent"
