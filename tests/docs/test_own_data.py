"""The page on own data, followed line by line: from the files of other programs to a prediction that VTK reads."""

import shlex
import subprocess
from pathlib import Path

import meshio
import numpy as np
import toy
from meshes import box
from test_pages import blocks, calls_of
from vtk_series import read

from ast_sim.cli import main
from ast_sim.dataset.reader import Dataset
from ast_sim.scene import NodeType
from ast_sim.simulate.calculix.program import find_ccx

PAGE = blocks((Path(__file__).parents[2] / "docs" / "how-to" / "own-data.md").read_text(encoding="utf-8"))
SHORT = ["train.steps=4", "train.batch_size=2", "train.statistics_pairs=4", "model.hidden=16", "model.d_token=16"]


def after_conversion() -> list[list[str]]:
    """The commands of the page from `info` on."""
    calls = calls_of(PAGE)
    return calls[[call[0] for call in calls].index("info") :]


def follow(*convert: str) -> Dataset:
    """Type the page's line that converts with these options, then all lines from `info` on; only the training is made
    shorter. Returns the dataset."""
    line = ["convert", "simulations", "--out", "data.h5", *convert]
    assert line in calls_of(PAGE)
    calls = [line, *after_conversion()]
    assert [call[0] for call in calls] == ["convert", "info", "report", "train", "predict", "evaluate"]
    for call in calls:
        settings = [part for setting in SHORT for part in ("--set", setting)] if call[0] == "train" else []
        assert main([*call, *settings]) == 0, shlex.join(call)
    return Dataset("data.h5")


def require_answer(truth) -> None:
    """VTK reads the answer: frames and nodes of the simulation, prescribed nodes in their places."""
    _, frames = read(Path("answer.vtkhdf"))
    assert len(frames) == truth.num_frames
    assert all(mesh.n_cells == truth.scene.num_elements for mesh in frames)
    held = truth.scene.prescribed
    np.testing.assert_allclose(frames[-1].points[held], truth.position[-1, held], atol=1e-6)
    assert all(np.isfinite(mesh.points).all() and np.isfinite(mesh["von_mises"]).all() for mesh in frames)


def press(path: Path, across: float, down: float, frames: int = 4) -> np.ndarray:
    """Write the deck of a block whose upper side is pushed; returns its nodes."""
    points, elements = box((3, 3, 2), (0.3, 0.3, 0.2))
    lower, upper = (np.flatnonzero(points[:, 2] * sign > 0.099) + 1 for sign in (-1, 1))

    def rows(table) -> str:
        return "\n".join(", ".join(map(str, row)) for row in table)

    lines = [
        "*NODE, NSET=ALL", rows((i, *point) for i, point in enumerate(points.round(6).tolist(), 1)),
        "*ELEMENT, TYPE=C3D4, ELSET=SOLID", rows((i, *element) for i, element in enumerate(elements + 1, 1)),
        "*NSET, NSET=LOWER", rows(lower[:, None]), "*NSET, NSET=UPPER", rows(upper[:, None]),
        "*MATERIAL, NAME=RUBBER", "*ELASTIC", "1e6, 0.3", "*SOLID SECTION, ELSET=SOLID, MATERIAL=RUBBER",
    ]  # fmt: skip
    for k in range(1, frames + 1):
        share = k / frames
        lines += [
            "*STEP, NLGEOM", "*STATIC", "1., 1.", "*BOUNDARY", "LOWER, 1, 3, 0.", f"UPPER, 1, 1, {across * share}",
            "UPPER, 2, 2, 0.", f"UPPER, 3, 3, {down * share}", "*NODE FILE, FREQUENCY=1000", "U",
            "*EL FILE, FREQUENCY=1000", "S", "*END STEP",
        ]  # fmt: skip
    path.write_text("\n".join(lines) + "\n")
    return points


def test_results_of_calculix(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "simulations").mkdir()
    for index in range(4):
        points = press(tmp_path / "simulations" / f"press{index}.inp", 0.01 * index, -0.02 - 0.005 * index)
        command = [find_ccx(), "-i", f"press{index}"]
        subprocess.run(command, cwd="simulations", check=True, capture_output=True)
    with follow("--displacement", "DISP", "--stress", "STRESS", "--handle", "0:zmin,zmax") as dataset:
        assert dataset.splits == {"train": 2, "valid": 1, "test": 1, "calibration": 0}
        found = [dataset[split][i] for split, count in dataset.splits.items() for i in range(count)]
        for truth in found:
            index = int(truth.attributes["source"].removeprefix("press")[0])
            np.testing.assert_allclose(truth.scene.rest_position, points, atol=1e-6)
            held = np.abs(points[:, 2]) > 0.099
            assert ((truth.scene.node_type == NodeType.HANDLE) == held).all() and truth.num_frames == 4
            upper = points[:, 2] > 0.099
            moved = truth.position[-1, upper] - truth.scene.rest_position[upper]
            np.testing.assert_allclose(moved, np.tile([0.01 * index, 0, -0.02 - 0.005 * index], (16, 1)), atol=1e-5)
            # Squeezed by a tenth and more: about E times the strain.
            assert 0.5e5 < np.median(truth.stress[-1]) < 4e5
        require_answer(dataset["test"][0])


def test_fields_called_u_s_mises_tool_and_fixed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in range(4):
        truth, folder = toy.plate(seed), tmp_path / "simulations" / f"case{seed}"
        folder.mkdir(parents=True)
        for frame, position in enumerate(truth.position):
            fields = {
                "U": position - truth.scene.rest_position,
                "S_Mises": truth.stress[frame, :, 0],
                "tool": (truth.scene.node_type == NodeType.OBSTACLE).astype(float),
                "fixed": (truth.scene.node_type == NodeType.HANDLE).astype(float),
            }
            cells = [("tetra", truth.scene.elements)]
            meshio.Mesh(truth.scene.rest_position, cells, fields).write(folder / f"{frame}.vtu")
    names = ("--displacement", "U", "--stress", "S_Mises", "--obstacle", "tool", "--handle", "fixed")
    with follow(*names) as dataset:
        assert dataset.splits == {"train": 2, "valid": 1, "test": 1, "calibration": 0}
        found = dataset["test"][0]
        truth = toy.plate(int(found.attributes["source"].removeprefix("case")))
        np.testing.assert_allclose(found.position, truth.position, atol=1e-7)
        assert (found.scene.node_type == truth.scene.node_type).all()
        assert (found.stress == truth.stress).all()
        require_answer(found)


def test_shells_as_tools(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * 0.1 - 0.05
    for seed in range(4):
        truth, folder = toy.plate(seed), tmp_path / "simulations" / f"case{seed}"
        folder.mkdir(parents=True)
        scene = truth.scene
        n = int((scene.body == 0).sum())
        elements = scene.elements[(scene.elements < n).all(axis=1)]
        for frame, position in enumerate(truth.position):
            travel = position[n, 2] - truth.position[0, n, 2]
            points = np.concatenate([position[:n], np.c_[square, np.full(4, 0.03 + travel)]])
            fields = {
                "von_mises": np.r_[truth.stress[frame, :n, 0], np.zeros(4)],
                "is_clamp": np.r_[(scene.node_type[:n] == NodeType.HANDLE).astype(float), np.zeros(4)],
            }
            cells = [("tetra", elements), ("quad", np.arange(4)[None] + n)]
            meshio.Mesh(points, cells, fields).write(folder / f"{frame}.vtu")
    with follow("--handle", "is_clamp") as dataset:
        assert "1 cell of the kind quad is a shell and becomes an obstacle" in capsys.readouterr().out
        found = dataset["test"][0]
        tool = found.scene.node_type == NodeType.OBSTACLE
        assert tool.sum() == 8 and found.scene.num_nodes in (48, 58)
        moved = found.position[:, tool, 2] - found.position[0, tool, 2]
        truth = toy.plate(int(found.attributes["source"].removeprefix("case"))).position[:, -1, 2]
        np.testing.assert_allclose(moved, np.tile((truth - truth[0])[:, None], (1, 8)), atol=1e-6)
        require_answer(found)
