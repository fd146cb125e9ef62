"""The script for `abaqus python`, with a stand-in for Abaqus's module: what it writes becomes a dataset. The stand-in
has the members that Abaqus documents, so this test cannot tell whether Abaqus itself has them."""

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from data_samples import block
from test_bodies_of_one_element import CORNERS

from ast_sim import Dataset, cli
from ast_sim.scene import NodeType
from ast_sim.simulate.shapes.mesh import second_order

SCRIPT = Path(__file__).parents[2] / "examples" / "abaqus" / "odb_to_vtu.py"
CUBE = block(1, 1, 1)
MESHES = {
    "C3D4": (CUBE.rest_position, CUBE.elements),
    "C3D10M": second_order(CUBE.rest_position.astype(float), CUBE.elements),
    "C3D8R": (CORNERS, np.arange(8)[None]),
    "C3D6": (CORNERS, np.array([[0, 1, 2, 4, 5, 6], [0, 2, 3, 4, 6, 7]])),
}
SHEET = np.array([(0, 0, 1.1), (1, 0, 1.1), (1, 1, 1.1), (0, 1, 1.1)])
TIMES = [(0.0, [0.0, 0.5, 1.0]), (1.0, [0.0, 2.0])]  # of each step: when it begins, and its frames
DOWN = {0.0: 0.0, 0.5: 0.1, 1.0: 0.2, 3.0: 0.15}  # by the total time
STRESS = np.array([30.0, 10, 20, 4, 5, 6])  # S11, S22, S33, S12, S13, S23


def some(**members):
    return SimpleNamespace(**members)


class Field:
    """A field output; ELEMENT_NODAL values are had from a subset."""

    def __init__(self, values, at_elements=()):
        self.values, self.at_elements = values, at_elements

    def getSubset(self, position):
        assert position == "ELEMENT_NODAL"
        return Field(self.at_elements)


def instance(name, points, elements, kind, first):
    nodes = [some(label=first + row, coordinates=tuple(map(float, point))) for row, point in enumerate(points)]
    cells = [some(type=kind, connectivity=tuple(int(first + n) for n in cell)) for cell in elements]
    return some(name=name, nodes=nodes, elements=cells, nodeSets={})


def value(one, label, data, double):
    """In jobs of double precision `data` is an error."""
    members = {"instance": one, "nodeLabel": label, "precision": "DOUBLE_PRECISION" if double else "SINGLE_PRECISION"}
    return some(**members, **{"dataDouble" if double else "data": data})


def results(kind, double):
    """A cube that a rigid sheet presses. Node labels of the two instances overlap, an element is of another kind, and a
    reference node has no element."""
    pad = instance("PAD-1", *MESHES[kind], kind, 11)
    sheet = instance("PUNCH-1", SHEET, [range(4)], "R3D4", 12)
    sheet.nodes.append(some(label=900, coordinates=(0.5, 0.5, 9.0)))
    pad.elements.append(some(type="S4R", connectivity=(11, 12, 13, 14)))
    pad.nodeSets["FLOOR"] = some(nodes=[node for node in pad.nodes if node.coordinates[2] == 0])
    both = some(instanceNames=("PAD-1", "PUNCH-1"), nodes=(pad.nodes[:1], sheet.nodes[-1:]))
    assembly = some(instances={"PUNCH-1": sheet, "PAD-1": pad}, nodeSets={" ALL & NONE": both})

    def frame(start, at):
        down = DOWN[start + at]
        moves = [(pad, node, -down * node.coordinates[2]) for node in pad.nodes]
        moves += [(sheet, node, -down) for node in sheet.nodes]
        u = [value(one, node.label, (0.0, 0.0, move), double) for one, node, move in moves]
        rf = [value(pad, node.label, (0.0, 0.0, 7.0 * down), double) for node in pad.nodeSets["FLOOR"].nodes]
        stress, strain = [], []
        for element in pad.elements:
            for share, label in enumerate(element.connectivity * 2):  # means of 0.5 and 1.5 times the stress
                factor = down * (0.5 if share < len(element.connectivity) else 1.5)
                length = 4 if element.type == "S4R" else 6
                stress.append(value(pad, label, tuple(factor * STRESS[:length]), double))
                strain.append(value(pad, label, 0.3 * factor, double))
        fields = {"U": Field(u), "RF": Field(rf), "S": Field((), stress), "PEEQ": Field((), strain)}
        return some(frameValue=at, fieldOutputs=fields)

    steps = {
        f"Step-{k}": some(name=f"Step-{k}", domain="TIME", totalTime=start, frames=[frame(start, at) for at in frames])
        for k, (start, frames) in enumerate(TIMES, 1)
    }
    return some(rootAssembly=assembly, steps=steps)


@pytest.fixture
def script(monkeypatch):
    """The module, with the results that Abaqus would open in `opened`."""
    opened = []
    access, constants = ModuleType("odbAccess"), ModuleType("abaqusConstants")
    access.openOdb = lambda path, readOnly: opened[-1]
    constants.ELEMENT_NODAL = "ELEMENT_NODAL"
    monkeypatch.setitem(sys.modules, "odbAccess", access)
    monkeypatch.setitem(sys.modules, "abaqusConstants", constants)
    spec = importlib.util.spec_from_file_location("odb_to_vtu", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, opened


def converted(folder, source, *options):
    units = ["--length-unit", "mm", "--stress-unit", "MPa", "--shares", "1", "0", "0"]
    names = ["--displacement", "U", "--stress", "S", *options]
    assert cli.main(["convert", str(source), "--out", str(folder / "d.h5"), *names, *units]) == 0
    with Dataset(folder / "d.h5") as data:
        return data["train"][0]


@pytest.mark.parametrize(("kind", "double"), [*((kind, False) for kind in MESHES), ("C3D8R", True)])
def test_what_the_script_writes_becomes_a_dataset(tmp_path, script, capsys, kind, double):
    module, opened = script
    opened.append(results(kind, double))
    module.main("jobs/press.odb", str(tmp_path / "out"))
    assert "left out: 1 elements of the type S4R" in capsys.readouterr().out
    points, _ = MESHES[kind]
    pvd = tmp_path / "out" / "press.pvd"
    options = ["--handle", "PAD-1.FLOOR", "--field", "PEEQ", "--reaction", "RF"]
    read = converted(tmp_path, pvd, *options)
    scene = read.scene
    assert read.times == (0, 0.5, 1, 3)
    pad = scene.body == scene.body[np.argmin(scene.rest_position[:, 2])]
    assert pad.sum() == len(points) and abs(scene.rest_volumes[pad[scene.elements[:, 0]]].sum()) == pytest.approx(1)
    down = np.array(list(DOWN.values()))[:, None]
    rest = scene.rest_position[pad]
    np.testing.assert_allclose(read.position[:, pad, 2], rest[:, 2] * (1 - down), atol=1e-6)
    sheet = scene.node_type == NodeType.OBSTACLE
    assert sheet.sum() >= 4 and not (sheet & pad).any()
    front = sheet & (scene.rest_position[:, 2] < 1.10001)
    np.testing.assert_allclose(read.position[:, front, 2], 1.1 - np.repeat(down, front.sum(), 1), atol=1e-6)
    assert np.array_equal(scene.node_type[pad] == NodeType.HANDLE, rest[:, 2] == 0)
    s = STRESS * 1e6
    mises = np.sqrt(((s[0] - s[1]) ** 2 + (s[1] - s[2]) ** 2 + (s[2] - s[0]) ** 2) / 2 + 3 * (s[3:] ** 2).sum())
    stressed = np.repeat(down, pad.sum(), 1)
    np.testing.assert_allclose(read.stress[:, pad, 0], stressed * mises, rtol=1e-5)
    np.testing.assert_allclose(read.fields["PEEQ"].values[:, pad].reshape(4, -1), 0.3 * stressed, rtol=1e-5)
    pushed = read.fields["reaction"].values[:, pad][:, rest[:, 2] == 0]
    np.testing.assert_allclose(pushed[:, :, 2], np.repeat(7 * down, pushed.shape[1], 1), rtol=1e-5)


def test_sets_and_instances_are_fields(tmp_path, script):
    """The set of the assembly has a name with a sign that XML keeps for itself, and a node without an element."""
    module, opened = script
    opened.append(results("C3D4", False))
    module.main("press.odb", str(tmp_path))
    read = converted(tmp_path, tmp_path / "press.pvd", "--obstacle", "PUNCH-1", "--handle", "ALL & NONE")
    held = np.flatnonzero(read.scene.node_type == NodeType.HANDLE)
    np.testing.assert_allclose(read.scene.rest_position[held], CUBE.rest_position[:1])


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda odb: odb.steps["Step-1"].frames[1].fieldOutputs.pop("U"), "A frame has no U"),
        (lambda odb: odb.steps["Step-1"].frames[1].fieldOutputs["U"].values.pop(3), "U is missing at 1 of 12 points"),
        (lambda odb: setattr(odb.steps["Step-2"], "domain", "FREQUENCY"), "The step Step-2 is no step in time"),
    ],
)
def test_what_cannot_be_written_is_said(tmp_path, script, spoil, told):
    module, opened = script
    opened.append(results("C3D4", False))
    spoil(opened[-1])
    with pytest.raises(SystemExit, match=told):
        module.main("press.odb", str(tmp_path))


def test_the_script_says_that_it_is_untried_and_needs_no_new_python():
    """Abaqus before 2024 has Python 2.7."""
    text = SCRIPT.read_text(encoding="utf-8")
    assert "Untried with Abaqus itself: no Abaqus is at hand." in text.splitlines()[0]
    new = (ast.JoinedStr, ast.AnnAssign, ast.NamedExpr, ast.Nonlocal, ast.AsyncFunctionDef, ast.Match, ast.YieldFrom)
    for node in ast.walk(ast.parse(text)):
        assert not isinstance(node, new)
        assert not isinstance(node, ast.FunctionDef) or not (node.returns or node.args.kwonlyargs)
        assert not isinstance(node, ast.List | ast.Tuple) or not any(isinstance(n, ast.Starred) for n in node.elts)
