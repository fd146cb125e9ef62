"""A job of CalculiX that does not converge: its last increment is no frame of the motion."""

import subprocess

import pytest
from blocks import block

from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

NAMES = FieldNames(stress_unit="MPa")
PAD = block(2, 2, 2)
MUCH = -5.0
FAILED = "the job did not converge: the increment at the time 2 is the state in which CalculiX gave up, and is left out"


def job(folder, output, moves):
    """A pad whose top is moved, a step for each move; few iterations are allowed for the largest one."""
    height = PAD.rest_position[:, 2]
    lines = ["*NODE"]
    lines += [f"{row + 1}, {x}, {y}, {z}" for row, (x, y, z) in enumerate(PAD.rest_position)]
    lines += ["*ELEMENT, TYPE=C3D4, ELSET=PAD"]
    lines += [f"{row + 1}, {', '.join(map(str, nodes + 1))}" for row, nodes in enumerate(PAD.elements)]
    lines += ["*NSET, NSET=LOW", *(f"{row + 1}," for row in (height == 0).nonzero()[0])]
    lines += ["*NSET, NSET=HIGH", *(f"{row + 1}," for row in (height == 2).nonzero()[0])]
    lines += ["*MATERIAL, NAME=SOFT", "*ELASTIC", "100., 0.3", "*SOLID SECTION, ELSET=PAD, MATERIAL=SOFT"]
    lines += ["*BOUNDARY", "LOW, 1, 3", "HIGH, 1, 2"]
    for move in moves:
        few = ["*CONTROLS, PARAMETERS=TIME INCREMENTATION", "2, 2, 3, 3, 10, 4, , 5"] if move == MUCH else []
        lines += ["*STEP, NLGEOM", *few, "*STATIC, DIRECT", "1., 1.", "*BOUNDARY", f"HIGH, 3, 3, {move}"]
        lines += [*output, "*END STEP"]
    (folder / "job.inp").write_text("\n".join(lines) + "\n")
    done = subprocess.run(["ccx", "job"], cwd=folder, check=False, capture_output=True, text=True, timeout=100)
    assert ("best solution and residuals are in the frd file" in done.stdout) == (MUCH in moves)
    return folder / "job.frd"


@pytest.mark.parametrize("status", [True, False])
@pytest.mark.parametrize("output", [("*NODE FILE", "U"), ("*NODE FILE", "U", "*EL FILE", "S")])
def test_the_state_in_which_calculix_gave_up_is_left_out(tmp_path, output, status):
    """It stands at the end of the step, as if it were solved."""
    results = job(tmp_path, output, (-0.1, MUCH))
    if not status:
        (tmp_path / "job.sta").unlink()
    with pytest.warns(UserWarning, match=FAILED):
        read = read_series(results, NAMES, deck=tmp_path / "job.inp")
    assert read.times == (0, 1)
    assert read.position[1, :, 2].max() == pytest.approx(1.9)
    with pytest.warns(UserWarning, match=FAILED):
        alone = read_series(results, FieldNames(displacement="DISP", handle="0:zmin"))
    assert len(alone.position) == 1


def test_a_status_file_tells_where_forces_are_asked_for_as_well(tmp_path):
    results = job(tmp_path, ("*NODE FILE", "U, RF"), (-0.1, MUCH))
    with pytest.warns(UserWarning, match=FAILED):
        assert read_series(results, NAMES, deck=tmp_path / "job.inp").times == (0, 1)


def test_a_job_that_failed_at_once_is_refused(tmp_path):
    results = job(tmp_path, ("*NODE FILE", "U"), (MUCH,))
    with pytest.raises(DatasetError, match=r"job.frd: the job did not converge: its only increment is the state"):
        read_series(results, NAMES, deck=tmp_path / "job.inp")


@pytest.mark.parametrize("output", [("*NODE FILE", "U, RF"), ("*NODE FILE", "U, RF", "*EL FILE", "S")])
def test_a_job_that_converged_keeps_its_last_increment(tmp_path, output):
    results = job(tmp_path, output, (-0.1, -0.2))
    assert read_series(results, NAMES, deck=tmp_path / "job.inp").times == (0, 1, 2)
