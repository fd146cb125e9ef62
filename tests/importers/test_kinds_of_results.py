"""Kinds of result files that once came in wrong or without a word: sets of nodes, parts in another order, moving
geometry, results of some nodes only."""

import meshio
import numpy as np
from blocks import block
from scipy.io import netcdf_file

from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.series import FieldNames, read_series
from ast_sim.scene import NodeType

PAD = block(2, 2, 2)
LOW = np.flatnonzero(PAD.rest_position[:, 2] == 0)
TOP = np.flatnonzero(PAD.rest_position[:, 2] == 2)
N = PAD.num_nodes


def pressed(frame):
    """[n, 3]: displacements of the pad; its height shrinks by 5 % a frame."""
    return PAD.rest_position * np.array((0, 0, -0.05 * frame))


def write_exodus(path, numbers):
    """Three frames of the pad, whose nodes have these numbers, with the sets of nodes LOW and TOP."""
    with netcdf_file(path, "w", version=2) as file:
        file.version = file.api_version = np.float32(5.1)
        file.floating_point_word_size = np.int32(8)
        file.file_size = np.int32(1)
        sizes = {"time_step": None, "len_string": 33, "num_dim": 3, "num_nodes": N, "num_elem": len(PAD.elements)}
        sizes |= {"num_el_blk": 1, "num_el_in_blk1": len(PAD.elements), "num_nod_per_el1": 4, "num_nod_var": 3}
        sizes |= {"num_node_sets": 2, "num_nod_ns1": len(LOW), "num_nod_ns2": len(TOP)}
        for name, size in sizes.items():
            file.createDimension(name, size)

        def put(name, *dimensions, values, kind="i"):
            variable = file.createVariable(name, kind, dimensions)
            variable[:] = values
            return variable

        for axis, name in enumerate(("coordx", "coordy", "coordz")):
            put(name, "num_nodes", values=PAD.rest_position[:, axis], kind="d")
        put("connect1", "num_el_in_blk1", "num_nod_per_el1", values=PAD.elements + 1).elem_type = "TETRA4"
        put("node_num_map", "num_nodes", values=numbers)
        for of, count in (("eb", "num_el_blk"), ("ns", "num_node_sets")):
            put(f"{of}_status", count, values=1)
            put(f"{of}_prop1", count, values=1 + np.arange(sizes[count])).name = "ID"
        put("ns_names", "num_node_sets", "len_string", values=characters("low", "top"), kind="c")
        for number, nodes in enumerate((LOW, TOP), 1):
            put(f"node_ns{number}", f"num_nod_ns{number}", values=nodes + 1)
        put("time_whole", "time_step", values=[0.0, 0.5, 1.0], kind="d")
        put("name_nod_var", "num_nod_var", "len_string", values=characters("displx", "disply", "displz"), kind="c")
        for axis in range(3):
            values = np.stack([pressed(frame)[:, axis] for frame in range(3)])
            put(f"vals_nod_var{axis + 1}", "time_step", "num_nodes", values=values, kind="d")


def characters(*texts):
    return np.array([list(text.ljust(33, "\0")) for text in texts], "S1")


def test_sets_of_nodes_of_exodus_are_groups(tmp_path):
    """Whatever numbers the file gives its nodes: sets hold places in the file."""
    for numbers in (1 + np.arange(N), 1 + np.random.default_rng(0).permutation(N), 1000 - 7 * np.arange(N)):
        write_exodus(tmp_path / "job.exo", numbers)
        read = read_series(tmp_path / "job.exo", FieldNames("displ", handle="low", obstacle="top"))
        at = {tuple(place) for place in read.scene.rest_position[read.scene.node_type == NodeType.HANDLE].tolist()}
        assert at == {tuple(place) for place in PAD.rest_position[LOW].tolist()}
        assert (read.scene.rest_position[read.scene.node_type == NodeType.OBSTACLE][:, 2] == 2).all()
        assert (read.scene.node_type == NodeType.OBSTACLE).sum() == len(TOP)
        np.testing.assert_allclose(read.position[2, :, 2], 0.9 * read.scene.rest_position[:, 2], rtol=1e-6)


def test_families_of_med_are_groups(tmp_path):
    """A family may belong to several groups, and a group may have several families."""
    tags = np.where(np.arange(len(PAD.elements)) < 6, -6, -7)
    families = np.zeros(N, int)
    families[LOW], families[TOP] = 2, 3
    mesh = meshio.Mesh(PAD.rest_position, [("tetra", PAD.elements)], {"point_tags": families}, {"cell_tags": [tags]})
    mesh.cell_tags = {-6: ["some", "all"], -7: ["all"]}
    mesh.point_tags = {2: ["low"], 3: ["top"]}
    mesh.write(tmp_path / "mesh.med")
    groups = read_mesh(tmp_path / "mesh.med").groups
    expected = {"low": LOW, "top": TOP, "some": np.unique(PAD.elements[:6]), "all": np.arange(N)}
    assert {name: nodes.tolist() for name, nodes in groups.items()} == {k: v.tolist() for k, v in expected.items()}
