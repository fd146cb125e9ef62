"""Second-order tetrahedra whose middle nodes lie so far from the middles of their edges that a part is inside out: told
with count and place, whatever the format; curved elements that are whole are not."""

from itertools import product

import meshio
import numpy as np
import pytest
from data_samples import block
from exodus_made import Netcdf, exodus

from ast_sim.element_topology import MIDDLES, signed_volumes, slopes_at, turned_over
from ast_sim.importers.convert import convert
from ast_sim.importers.scene_mesh import read_scene
from ast_sim.importers.series import FieldNames
from ast_sim.plausibility.curved_elements import partly_inside_out
from ast_sim.plausibility.topology import at_rest
from ast_sim.scene import Scene
from ast_sim.simulate.shapes.mesh import second_order
from ast_sim.support.errors import DatasetError, LooksWrong

PLAIN = block(2, 2, 2)
NODES, ELEMENTS = second_order(PLAIN.rest_position.astype(float), PLAIN.elements)
WHAT = "elements of which a part is inside out"


def shifted(edge, share, element=0):
    """The nodes, one of them moved along its edge by a share of the edge; the elements that have it."""
    one, other = NODES[ELEMENTS[element, list(MIDDLES[edge])]]
    node = ELEMENTS[element, 4 + edge]
    nodes = NODES.copy()
    nodes[node] += share * (other - one)
    return nodes, np.flatnonzero((node == ELEMENTS).any(axis=1)).tolist()


def findings(nodes, elements=ELEMENTS):
    none = np.zeros(len(nodes), np.uint8)
    scene = Scene(nodes.astype(np.float32), elements.astype(np.int32), none, none.astype(np.int32))
    return {one.what: one for one in at_rest(scene)}


@pytest.mark.parametrize("edge", range(6))
def test_a_middle_a_quarter_of_its_edge_away_is_told(edge):
    for share in (0.1, 0.2, 0.2499, -0.2499):
        assert not findings(shifted(edge, share)[0])
    for share in (0.25, 0.26, 0.4, 0.4999, 0.5, -0.25, -0.5):  # 0.5: at a corner
        for element in (0, 40):
            nodes, rows = shifted(edge, share, element)
            told = findings(nodes)
            assert list(told) == [WHAT] and told[WHAT].count == len(rows)
            assert told[WHAT].places.startswith("elements " + ", ".join(map(str, rows[:3])))
            assert "mesh it again" in told[WHAT].meaning


def test_elements_that_are_numbered_inside_out_are_looked_at_alike():
    for share, told in ((0.2, []), (0.3, [WHAT])):
        nodes, _ = shifted(2, share)
        assert list(findings(nodes, turned_over(ELEMENTS, np.ones(len(ELEMENTS), bool)))) == told
        assert list(findings(nodes * (1, 1, -1))) == told


def test_curved_elements_that_are_whole_are_not_told():
    for radius in (1.0, 2.0, 4.0):  # of a bent bar, with its nodes on the arcs
        angle = NODES[:, 0] / (1 + radius)
        bent = np.stack([(radius + NODES[:, 2]) * np.sin(angle), NODES[:, 1], (radius + NODES[:, 2]) * np.cos(angle)])
        assert not findings(bent.T)
    scattered = NODES + np.random.default_rng(0).uniform(-0.05, 0.05, NODES.shape)
    assert not findings(scattered)
    assert not findings(NODES * (1, 1, 1e-3)) and not findings(NODES + 1000)


def test_each_element_is_decided_as_by_a_fine_lattice():
    """Corners, edges, faces and the inside: what is inside out anywhere is seen, and nothing else."""
    rng = np.random.default_rng(1)
    count = 1000
    one = second_order(np.concatenate([np.zeros((1, 3)), np.eye(3)]), np.arange(4)[None])
    shape = one[0][one[1][0]]
    points = (shape + rng.uniform(-1, 1, (count, 10, 3)) * rng.uniform(0, 0.35, (count, 1, 1))).reshape(-1, 3)
    elements = np.arange(10 * count).reshape(count, 10)
    sign = np.where(signed_volumes(points, elements) < 0, -1, 1)
    lattice = np.array([powers for powers in product(range(11), repeat=4) if sum(powers) == 10]) / 10
    at = [np.linalg.det(np.einsum("eai,ak->eik", points[elements], slopes)) for slopes in slopes_at(lattice)]
    lowest = np.min(sign * np.array(at), axis=0)
    sure = np.abs(lowest) > 1e-3
    assert 0.2 < (lowest < 0).mean() < 0.8 and sure.mean() > 0.9
    assert np.array_equal(partly_inside_out(points, elements)[sure], (lowest < 0)[sure])
    only_within = (np.array(at)[(lattice == 1).any(axis=1)] * sign > 0).all(axis=0) & (lowest < -1e-3)
    assert only_within.any() and partly_inside_out(points, elements)[only_within].all()


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "inp", "xdmf", "e"])
def test_files_of_each_format_are_told(tmp_path, ending):
    path = tmp_path / f"mesh.{ending}"
    for share in (0.2, 0.3, 0.5):
        nodes, rows = shifted(4, share)
        if ending == "e":
            exodus(nodes, [("TETRA10", 1, "pad", ELEMENTS)], {}, times=(), node_sets=()).write(path)
        else:
            kind = "gmsh" if ending == "msh" else None
            meshio.write(path, meshio.Mesh(nodes, [("tetra10", ELEMENTS)]), kind)
        warnings = read_scene(path, clamps=["0:xmin"]).warnings
        assert [one.split(" (")[0] for one in warnings] == ([f"{len(rows)} {WHAT}"] if share > 0.25 else [])
        corners = read_scene(path, clamps=["0:xmin"], corners=True)
        assert not [one for one in corners.warnings if WHAT in one]


def results(nodes) -> Netcdf:
    moved = np.stack([np.zeros(len(nodes)), -0.1 * nodes[:, 2]])
    values = {"disp_x": 0 * moved, "disp_y": 0 * moved, "disp_z": moved}
    low = ("low", np.flatnonzero(NODES[:, 2] == 0))
    return exodus(nodes, [("TETRA10", 1, "pad", ELEMENTS)], values, times=(0.0, 1.0), node_sets=[low])


def test_convert_tells_them_and_refuses_them_if_strict(tmp_path):
    options = {"splits": {"train": 1, "valid": 0, "test": 0}, "names": FieldNames("disp", handle="low")}
    nodes, rows = shifted(4, 0.5)
    results(nodes).write(tmp_path / "a.e")
    with pytest.warns(LooksWrong, match=f"{len(rows)} {WHAT}"):
        convert(tmp_path / "a.e", tmp_path / "d.h5", progress=False, **options)
    with pytest.raises(DatasetError, match=f"a.e: {len(rows)} {WHAT} .a: elements 0, .*mesh it again"):
        convert(tmp_path / "a.e", tmp_path / "s.h5", progress=False, strict=True, **options)
    assert not (tmp_path / "s.h5").exists()
    results(NODES).write(tmp_path / "a.e")
    convert(tmp_path / "a.e", tmp_path / "s.h5", progress=False, strict=True, **options)
