"""Several simulations in one `convert`: what is wrong between them is told or refused."""

import meshio
import numpy as np
import pytest
from data_samples import block

from ast_sim.cli import main
from ast_sim.dataset.contents import describe_dataset
from ast_sim.importers.convert import convert
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.plausibility.motion import in_trajectory
from ast_sim.scene import Trajectory
from ast_sim.support.errors import DatasetError

CUBE = block(1, 1, 1)
NAMES = FieldNames(handle="0:zmin")


def write(folder, press, unit=1.0, stress=None, poisson=0.3):
    """A cube that is pressed, in three frames; stress at the nodes or in the elements."""
    folder.mkdir(parents=True)
    for frame in range(3):
        points = unit * CUBE.rest_position * (1, 1, 1 - press * frame)
        at_nodes = {"von_mises": np.full(8, 1e6 * frame)} if stress == "node" else {}
        in_elements = {"von_mises": [np.full(len(CUBE.elements), 1e6 * frame)]} if stress == "element" else {}
        in_elements["nu"] = [np.full(len(CUBE.elements), poisson)]
        meshio.Mesh(points, [("tetra", CUBE.elements)], at_nodes, in_elements).write(folder / f"f{frame}.vtu")


def told(source, recwarn):
    convert(source, source / "o.h5", names=NAMES, splits={"train": 1}, progress=False)
    in_dataset = [one["what"] for one in describe_dataset(source / "o.h5")["looks_wrong"]]
    return [str(one.message) for one in recwarn], in_dataset


def test_a_simulation_that_stands_in_the_data_twice_is_told(tmp_path, recwarn):
    for name, press in (("a", 0.1), ("b", 0.05), ("c", 0.1)):
        write(tmp_path / name, press)
    lines, in_dataset = told(tmp_path, recwarn)
    assert "simulations that stand in the data twice: 1" in lines[1] and "c: as a" in lines[1]
    assert in_dataset == ["simulations that stand in the data twice"]


@pytest.mark.parametrize(("unit", "told_of"), [(1000, 1), (0.001, 1), (20, 0)])
def test_a_simulation_in_another_unit_of_length_is_told(tmp_path, recwarn, unit, told_of):
    write(tmp_path / "a", 0.1)
    write(tmp_path / "b", 0.05, unit)
    lines, in_dataset = told(tmp_path, recwarn)
    assert in_dataset == told_of * ["simulations of another size"]
    assert ("a has the size 1: are all in one unit of length?" in "".join(lines)) == bool(told_of)


@pytest.mark.parametrize(("one", "other"), [("node", None), (None, "node"), ("node", "element")])
def test_a_stress_at_another_place_names_the_simulation(tmp_path, one, other):
    write(tmp_path / "a", 0.1, stress=one)
    write(tmp_path / "b", 0.05, stress=other)
    message = f"b: the place of its stress is {other or 'none'!r}, in the simulations before {one or 'none'!r}"
    with pytest.raises(DatasetError, match=message):
        convert(tmp_path, tmp_path / "o.h5", names=NAMES, splits={"train": 1}, progress=False)


@pytest.mark.parametrize(("poisson", "told_of"), [(0.49, 0), (0.0, 0), (0.5, 1), (2e5, 1)])
def test_a_poissons_ratio_that_cannot_be_one_is_told(tmp_path, poisson, told_of):
    """Such as Young's modulus, where the two fields changed their names."""
    write(tmp_path / "a", 0.1, poisson=poisson)
    findings = in_trajectory(read_series(tmp_path / "a", FieldNames(handle="0:zmin", material=("poisson=nu",))))
    assert [one.what for one in findings] == told_of * ["elements whose Poisson's ratio cannot be one"]


@pytest.mark.parametrize(
    ("order", "places"),
    [
        ((0, 1, 1, 2), ["frame 2"]),  # a pause
        ((0, 1, 2, 2, 2), ["frames 3, 4"]),  # a hold at the end
        ((0, 0, 1, 2), ["frame 1"]),
        ((0, 0, 1, 1, 2, 2, 1, 1), ["frames 1, 3, 5, ..."]),  # each one twice
        ((0, 1, 0, 1, 2), []),  # there and back: no frame is the one before
    ],
)
def test_frames_that_repeat_are_told_but_may_be_meant(tmp_path, recwarn, order, places):
    """Without inertia a frame is the one before once more wherever the prescribed nodes hold still, so a look tells it,
    and --strict lets it pass. Where nothing moves at all, that is told alone."""
    (tmp_path / "a").mkdir()
    for number, place in enumerate(order):
        points = CUBE.rest_position * (1, 1, 1 - 0.1 * place)
        meshio.Mesh(points, [("tetra", CUBE.elements)]).write(tmp_path / "a" / f"f{number}.vtu")
    convert(tmp_path, tmp_path / "o.h5", names=NAMES, splits={"train": 1}, strict=True, progress=False)
    wrong = describe_dataset(tmp_path / "o.h5")["looks_wrong"]
    assert [one["places"] for one in wrong] == places and all(one["may_be_meant"] for one in wrong)
    lines = [str(one.message) for one in recwarn]
    repeats = sum(one == other for one, other in zip(order, order[1:], strict=False))
    counted = f"{repeats} frames that repeat" if repeats > 1 else "frames that repeat: 1"
    assert sum(counted in line and "a pause of the motion, or was it written twice?" in line for line in lines) == bool(
        places
    )
    assert main(["info", str(tmp_path / "o.h5"), "--strict"]) == 0


def test_what_cannot_be_meant_is_refused_beside_frames_that_repeat(tmp_path):
    for name in "ab":
        write(tmp_path / name, 0.1)
        (tmp_path / name / "f3.vtu").write_bytes((tmp_path / name / "f2.vtu").read_bytes())
    with pytest.raises(DatasetError, match="stand in the data twice: 1 .b: as a.*leave one out$") as caught:
        convert(tmp_path, tmp_path / "o.h5", names=NAMES, splits={"train": 1}, strict=True, progress=False)
    assert "repeat" not in str(caught.value)
    with pytest.warns(UserWarning):
        convert(tmp_path, tmp_path / "o.h5", names=NAMES, splits={"train": 1}, progress=False)
    assert main(["info", str(tmp_path / "o.h5"), "--strict"]) == 2


def test_a_simulation_without_motion_is_told_as_that_alone():
    still = Trajectory(CUBE, np.repeat(CUBE.rest_position[None], 3, axis=0), attributes={"source": "a"})
    assert [one.what for one in in_trajectory(still)] == ["simulations without motion"]
