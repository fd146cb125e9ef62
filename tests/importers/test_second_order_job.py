"""A body of second-order tetrahedra that CalculiX pulls: its ten nodes are kept from the files to the force."""

import subprocess
import warnings

import meshio
import numpy as np
import pytest
from data_samples import block

import ast_sim
from ast_sim import Dataset, cli
from ast_sim.importers.formats.vtk_files import vtk_frames
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.inference.promises.calibration import Calibration
from ast_sim.inference.promises.kept_errors import KeptErrors
from ast_sim.inference.quantities.band import compared
from ast_sim.scene import NodeType
from ast_sim.simulate.shapes.mesh import second_order

NAMES = FieldNames(stress_unit="MPa")
PULL = 0.001
YOUNG, POISSON = 100.0, 0.3  # MPa


def deck(nodes, elements) -> str:
    """A block whose floor z = 0 is held and whose top z = 2 is moved up, in two increments."""
    rows = [f"{1 + row}, {x:.9g}, {y:.9g}, {z:.9g}" for row, (x, y, z) in enumerate(nodes)]
    cells = [", ".join(map(str, [1 + row, *(1 + cell)])) for row, cell in enumerate(elements)]
    floor, top = (1 + np.flatnonzero(nodes[:, 2] == height) for height in (0, 2))
    lines = ["*NODE", *rows, "*ELEMENT, TYPE=C3D10, ELSET=PAD", *cells]
    lines += ["*NSET, NSET=FLOOR", *map(str, floor), "*NSET, NSET=TOP", *map(str, top)]
    lines += ["*MATERIAL, NAME=SOFT", "*ELASTIC", f"{YOUNG}, {POISSON}", "*SOLID SECTION, ELSET=PAD, MATERIAL=SOFT"]
    lines += [
        "*STEP, NLGEOM",
        "*STATIC, DIRECT",
        "0.5, 1.",
        "*BOUNDARY",
        "FLOOR, 1, 3",
        "TOP, 1, 2",
        f"TOP, 3, 3, {PULL}",
    ]
    lines += ["*NODE FILE", "U, RF", "*EL FILE", "S", "*END STEP"]
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def pulled(tmp_path_factory):
    """The deck and the results of a job, its nodes [N, 3] and elements [E, 10]."""
    folder = tmp_path_factory.mktemp("pulled")
    corners = block(2, 2, 2)
    nodes, elements = second_order(corners.rest_position.astype(float), corners.elements)
    (folder / "job.inp").write_text(deck(nodes, elements))
    subprocess.run(["ccx", "job"], cwd=folder, check=True, capture_output=True, timeout=100)
    return folder / "job.inp", folder / "job.frd", nodes, elements


def test_convert_train_predict_and_the_force(pulled, tmp_path, capsys):
    job, results, nodes, elements = pulled
    data, run = tmp_path / "d.h5", tmp_path / "run"
    units = ["--length-unit", "mm", "--stress-unit", "MPa"]
    kept = ["--reaction", "RF", "--field", "ERROR=%"]
    shares = ["--shares", "1", "0", "0"]
    assert cli.main(["convert", str(job), str(results), "--out", str(data), *shares, *units, *kept]) == 0
    assert "corners only" not in capsys.readouterr().out
    with Dataset(data) as dataset:
        assert dataset.element_size == 10
        truth = dataset["train"][0]
    scene = truth.scene
    assert np.array_equal(scene.elements, elements)
    assert np.array_equal(scene.node_type == NodeType.HANDLE, np.isin(nodes[:, 2], (0, 2)))
    np.testing.assert_allclose(truth.position[-1][nodes[:, 2] == 2], nodes[nodes[:, 2] == 2] + (0, 0, PULL), atol=1e-6)
    assert cli.main(["train", str(data), "--out", str(run), "--set", "train.steps=20"]) == 0
    effort = ast_sim.Effort(newton_steps=10)
    answer = ast_sim.Run(run).predict(scene, truth.position, effort=effort, frames=[-1])
    assert answer.converged
    np.testing.assert_allclose(answer.position[-1], truth.position[-1], atol=0.01 * PULL)
    # The dataset keeps the forces of the job in newton: lengths in mm and stress in MPa go with these.
    top = nodes[:, 2] == 2
    reaction = truth.fields["reaction"]
    assert (reaction.location, reaction.unit, reaction.values.shape) == ("node", "N", (3, len(nodes), 3))
    assert not reaction.values[0].any() and (truth.fields["ERROR"].location, truth.fields["ERROR"].unit) == (
        "node",
        "%",
    )
    # CalculiX's law (Saint Venant-Kirchhoff) and ours (Neo-Hooke) differ by about 2.5 times the strain, PULL / 2.
    *_, last = vtk_frames(results)
    force = last.point_fields["FORC"][top].sum(axis=0)
    np.testing.assert_allclose(reaction.values[-1][top].sum(axis=0), force, rtol=1e-5, atol=1e-5 * force[2])
    assert reaction.values[-1].sum(axis=0) == pytest.approx(0, abs=1e-4 * force[2])
    assert answer.reaction()[0] == pytest.approx(force, rel=2.5e-3, abs=2.5e-3 * force[2])


def test_corners_are_taken_when_they_are_asked_for(pulled):
    job, results, nodes, elements = pulled
    read = read_series(results, NAMES, deck=job, corners=True)
    used = np.unique(elements[:, :4])
    assert np.array_equal(used[read.scene.elements], elements[:, :4])
    np.testing.assert_allclose(read.scene.rest_position, nodes[used], atol=1e-6)
    assert f"{len(elements)} cells of the kind C3D10 keep their corners only" in read.attributes["notes"]


def told_by(function, *arguments):
    """What it returns, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = function(*arguments)
    return result, [str(one.message) for one in caught]


STIFFER = "the run learned from elements of a higher order by their corners only"


@pytest.mark.parametrize("corners", [False, True])
def test_no_force_is_promised_where_elements_keep_their_corners_only(pulled, tmp_path, corners):
    """The fact goes from the files to the dataset, the run, its answers and their files. Ten nodes are no such fact."""
    job, results, *_ = pulled
    data = tmp_path / "d.h5"
    units = {"length_unit": "mm", "names": FieldNames(stress_unit="MPa")}
    ast_sim.convert(results, data, deck=job, corners=corners, splits={"train": 1}, progress=False, **units)
    with Dataset(data) as dataset:
        assert dataset.info.corners_only == corners
        truth = dataset["train"][0]
    run = ast_sim.train(data, tmp_path / "run", steps=2, progress=False)
    assert run.info.corners_only == corners
    answer = run.predict(truth, frames=[-1], effort=ast_sim.Effort(newton_steps=10))
    for force in (answer.reaction, answer.body_forces, lambda: answer.save_forces(tmp_path / "f.csv")):
        _, lines = told_by(force)
        assert [STIFFER in line for line in lines] == corners * [True]
    assert "the force is not the one of the simulations" in "".join(lines) or not corners
    assert ("reaction" in compared(answer, truth)) != corners
    assert answer.band() is None
    run.calibration = Calibration(20, (), {}, {}, (0.1, 10.0), (0.0, 10.0), KeptErrors((), {}), None)
    if corners:
        with pytest.raises(ast_sim.ConfigError, match=f"no force is promised: {STIFFER}"):
            answer.band("reaction")
        with pytest.raises(ast_sim.ConfigError, match=f"promises no force: {STIFFER}"):
            run.predict(truth, error={"reaction": 0.1})
    else:
        assert answer.band("reaction") is None
    answer.save(tmp_path / "a.h5")
    with Dataset(tmp_path / "a.h5") as saved:
        assert saved.info.corners_only == corners
    later = ast_sim.train(data, tmp_path / "later", steps=2, from_run=run, progress=False)
    assert later.info.corners_only == corners
    scene = ast_sim.read_scene(results, clamps=["0:zmin"], corners=corners)
    assert any("no force of theirs is right" in line for line in scene.warnings) == corners


def squeezed(folder, kind):
    """A dataset of a cube that is squeezed, in elements of a kind of meshio, by their corners."""
    cube = block(2, 2, 2)
    rest, elements = cube.rest_position.astype(float), cube.elements
    if kind == "tetra10":
        rest, elements = second_order(rest, elements)
    folder.mkdir()
    for frame in range(3):
        meshio.Mesh(rest * (1, 1, 1 - 0.1 * frame), [(kind, elements)]).write(folder / f"f{frame}.vtu")
    names = FieldNames(handle="0:zmin")
    path = folder / "o.h5"
    ast_sim.convert(folder, path, names=names, corners=True, splits={"train": 1}, progress=False)
    return path


def test_corners_of_linear_elements_are_all_their_nodes_and_a_later_training_knows_of_others(tmp_path):
    linear, reduced = (squeezed(tmp_path / kind, kind) for kind in ("tetra", "tetra10"))
    for path, corners_only in ((linear, False), (reduced, True)):
        with Dataset(path) as dataset:
            assert (dataset.info.corners_only, dataset.element_size) == (corners_only, 4)
    run = ast_sim.train(linear, tmp_path / "run", steps=2, progress=False)
    later = ast_sim.train(reduced, tmp_path / "later", steps=2, from_run=run, progress=False)
    assert (run.info.corners_only, later.info.corners_only) == (False, True)
