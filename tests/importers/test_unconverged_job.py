"""A job of CalculiX that does not converge: its last increment is no frame of the motion."""

import subprocess
from dataclasses import replace

import pytest
from data_samples import block

from ast_sim.importers.series import FieldNames, read_series
from ast_sim.support.errors import DatasetError

NAMES = FieldNames(stress_unit="MPa")
PAD = block(2, 2, 2)
MUCH = -5.0
FAILED = "the job did not converge: the increment at the time 2 is the state in which CalculiX gave up, and is left out"


def job(folder, output, moves, held=("LOW, 1, 3", "HIGH, 1, 2")):
    """A pad whose top is moved, a step for each move; few iterations are allowed for the largest one."""
    height = PAD.rest_position[:, 2]
    lines = ["*NODE"]
    lines += [f"{row + 1}, {x}, {y}, {z}" for row, (x, y, z) in enumerate(PAD.rest_position)]
    lines += ["*ELEMENT, TYPE=C3D4, ELSET=PAD"]
    lines += [f"{row + 1}, {', '.join(map(str, nodes + 1))}" for row, nodes in enumerate(PAD.elements)]
    lines += ["*NSET, NSET=LOW", *(f"{row + 1}," for row in (height == 0).nonzero()[0])]
    lines += ["*NSET, NSET=HIGH", *(f"{row + 1}," for row in (height == 2).nonzero()[0])]
    lines += ["*MATERIAL, NAME=SOFT", "*ELASTIC", "100., 0.3", "*SOLID SECTION, ELSET=PAD, MATERIAL=SOFT"]
    lines += ["*BOUNDARY", *held]
    for move in moves:
        few = ["*CONTROLS, PARAMETERS=TIME INCREMENTATION", "2, 2, 3, 3, 10, 4, , 5"] if move == MUCH else []
        lines += ["*STEP, NLGEOM", *few, "*STATIC, DIRECT", "1., 1.", "*BOUNDARY", f"HIGH, 3, 3, {move}"]
        lines += [*output, "*END STEP"]
    (folder / "job.inp").write_text("\n".join(lines) + "\n")
    done = subprocess.run(["ccx", "job"], cwd=folder, check=False, capture_output=True, text=True, timeout=100)
    assert ("best solution and residuals are in the frd file" in done.stdout) == (MUCH in moves)
    return folder / "job.frd"


@pytest.mark.parametrize("status", [True, False])
@pytest.mark.parametrize(
    "output",
    [
        ("*NODE FILE", "U"),
        ("*NODE FILE", "U", "*EL FILE", "S"),
        ("*NODE FILE", "U, RF"),
        ("*NODE OUTPUT", "U, RF"),
        ("*NODE FILE", "U, RF", "*EL FILE", "S"),
    ],
)
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


@pytest.mark.parametrize("status", [True, False])
def test_a_job_that_failed_at_once_is_refused(tmp_path, status):
    results = job(tmp_path, ("*NODE FILE", "U"), (MUCH,))
    if not status:
        (tmp_path / "job.sta").unlink()
    with pytest.raises(DatasetError, match=r"job.frd: the job did not converge: its only increment is the state"):
        read_series(results, NAMES, deck=tmp_path / "job.inp")


@pytest.mark.parametrize("ended", [True, False])
@pytest.mark.parametrize("output", [("*NODE FILE", "U, RF"), ("*NODE FILE", "U, RF", "*EL FILE", "S")])
def test_a_job_that_converged_keeps_its_last_increment(tmp_path, output, ended):
    """Also if it was stopped after it: then the mark at the end of its results is missing, and there may be no
    status file."""
    results = job(tmp_path, output, (-0.1, -0.2))
    if not ended:
        (tmp_path / "job.sta").unlink()
        results.write_bytes(results.read_bytes().removesuffix(b" 9999\n"))
    assert read_series(results, NAMES, deck=tmp_path / "job.inp").times == (0, 1, 2)


def test_forces_that_are_left_over_are_no_reactions(tmp_path):
    """CalculiX also gives up after an increment that converged, if the next would be too short: the status file calls
    it good, but its forces are what is left over."""
    results = job(tmp_path, ("*NODE FILE", "U, RF"), (-0.1, MUCH))
    good = (tmp_path / "job.sta").read_text().replace("1U    2  0.100000E+01", "1     2  0.200000E+01")
    (tmp_path / "job.sta").write_text(good)
    with pytest.warns(UserWarning, match=FAILED):
        read = read_series(results, replace(NAMES, reaction="RF"), deck=tmp_path / "job.inp")
    assert read.times == (0, 1)


def test_a_doubt_is_told_where_no_node_is_held(tmp_path):
    results = job(tmp_path, ("*NODE FILE", "U, RF"), (-0.1, MUCH), held=("LOW, 1, 3, 0.01", "HIGH, 1, 2, 0.02"))
    (tmp_path / "job.sta").unlink()
    with pytest.warns(UserWarning, match=r"its last increment, at the time 2, converged or is the state in which"):
        read_series(results, NAMES, deck=tmp_path / "job.inp")


@pytest.mark.parametrize("output", ["*NODE FILE", "*NODE OUTPUT"])
@pytest.mark.parametrize("lines", [2, 20, 40])
def test_results_that_are_cut_off_are_refused(tmp_path, output, lines):
    """A reader fills what is missing with zeros."""
    results = job(tmp_path, (output, "U, RF"), (-0.1, -0.2))
    content = results.read_bytes()
    row = 12 if output == "*NODE OUTPUT" else 50
    results.write_bytes(content[: len(content) - len(b" -3\n 9999\n") - lines * row])
    with pytest.raises(DatasetError, match=r"job.frd: is cut off in (FORC|DISP) at the time 2: copy it whole, or"):
        read_series(results, NAMES, deck=tmp_path / "job.inp")
