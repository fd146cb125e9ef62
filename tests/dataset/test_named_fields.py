"""Named fields of a trajectory: written, read, compared with the mesh and guarded by hashes."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from data_samples import block, trajectory, write
from meshes import two_tetrahedra

from ast_sim import Dataset
from ast_sim.dataset.contents import describe_dataset
from ast_sim.dataset.layout import HASH, write_attributes
from ast_sim.named_field import REACTION, NamedField
from ast_sim.support.errors import DatasetError
from ast_sim.view import export


def numbers(*shape):
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


def with_fields(scene, frames, **more):
    n, e = scene.num_nodes, scene.num_elements
    fields = {
        "PEEQ": NamedField(numbers(frames, n, 1), "node"),
        "heat flux": NamedField(numbers(frames, e, 3), "element", "W/m2"),
        REACTION: NamedField(numbers(frames, n, 3), "node", "N"),
        **more,
    }
    return replace(
        trajectory(scene, frames, 1, "none"), fields={key: one for key, one in fields.items() if one is not None}
    )


def test_fields_come_back_with_place_and_unit(tmp_path):
    given = [with_fields(block(2, 1, 1), 4), with_fields(two_tetrahedra(), 2)]
    path = write(tmp_path / "d.h5", {"train": given})
    with Dataset(path) as dataset:
        assert dataset.load("train", 0).fields == {}  # only who asks for them reads them
        for read, wanted in zip(dataset["train"], given, strict=True):
            assert list(read.fields) == sorted(wanted.fields)
            for name, one in wanted.fields.items():
                assert np.array_equal(read.fields[name].values, one.values)
                assert (read.fields[name].location, read.fields[name].unit) == (one.location, one.unit)
        part = dataset["train"][0].select([1, 3])
        assert np.array_equal(part.fields["PEEQ"].values, given[0].fields["PEEQ"].values[[1, 3]])
    shown = describe_dataset(path)["splits"]["train"]["fields"]
    assert shown["heat flux"] == "float32, 3 in a row at each element, W/m2"


def test_a_file_for_paraview_has_the_fields(tmp_path):
    import pyvista

    given = with_fields(block(2, 1, 1), 2)
    export.write(tmp_path / "a.pvd", given)
    grid = pyvista.read(tmp_path / "a" / "frame_00001.vtu")
    assert np.array_equal(grid.point_data["PEEQ"], given.fields["PEEQ"].values[1, :, 0])
    assert np.array_equal(grid.cell_data["heat flux"], given.fields["heat flux"].values[1])
    assert np.array_equal(grid.point_data[REACTION], given.fields[REACTION].values[1])


WRONG = {
    "not finite": ({"PEEQ": NamedField(np.full((2, 5, 1), np.nan, np.float32), "node")}, "PEEQ in frame 0 at node 0"),
    "rows": ({"PEEQ": NamedField(numbers(2, 4, 1), "node")}, "PEEQ .*5"),
    "place": ({"PEEQ": NamedField(numbers(2, 5, 1), "face")}, "the field PEEQ is at 'face'"),
    "dtype": ({"PEEQ": NamedField(numbers(2, 5, 1).astype(np.float64), "node")}, "PEEQ"),
    "slash": ({"a/b": NamedField(numbers(2, 5, 1), "node")}, "a field has the name 'a/b'"),
    "columns": ({"PEEQ": NamedField(numbers(2, 5, 0), "node")}, "the field PEEQ has no columns"),
    "reaction": ({REACTION: NamedField(numbers(2, 5, 3), "node", "kN")}, "reaction must have 3 columns at the nodes"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_field_is_refused_by_name(tmp_path, case):
    more, message = WRONG[case]
    with pytest.raises(DatasetError, match=message):
        write(tmp_path / "d.h5", {"train": [with_fields(two_tetrahedra(), 2, **more)]})
    assert not (tmp_path / "d.h5").exists()


def test_all_trajectories_have_the_same_fields(tmp_path):
    given = [with_fields(two_tetrahedra(), 2), with_fields(two_tetrahedra(), 2, PEEQ=None)]
    with pytest.raises(DatasetError, match=r"has the fields heat flux .*; other samples have PEEQ \(1 at each node"):
        write(tmp_path / "d.h5", {"train": given})


def edited(path, change):
    with h5py.File(path, "r+") as file:
        change(file["train/000000"])


EDITS = {
    "values": lambda g: g["fields/PEEQ"].__setitem__((0, 0, 0), 7),
    "unit": lambda g: write_attributes(g["fields/heat flux"], {"unit": "kW/m2"}),
    "location": lambda g: write_attributes(g["fields/PEEQ"], {"location": "element"}),
    "removed": lambda g: g["fields"].__delitem__("PEEQ"),
    "all removed": lambda g: g.__delitem__("fields"),
    "hash": lambda g: write_attributes(g["fields/PEEQ"], {HASH: "0" * 64}),
    "link": lambda g: (g["fields"].__delitem__("PEEQ"), g["fields"].__setitem__("PEEQ", h5py.SoftLink("/train"))),
    "external": lambda g: (g.__delitem__("fields"), g.__setitem__("fields", h5py.ExternalLink("x.h5", "/"))),
}


@pytest.mark.parametrize("case", EDITS)
def test_an_edited_field_is_noticed(tmp_path, case):
    path = write(tmp_path / "d.h5", {"train": [with_fields(two_tetrahedra(), 2)]})
    edited(path, EDITS[case])
    with Dataset(path) as dataset, pytest.raises(DatasetError, match=r"d.h5: "):
        _ = dataset["train"][0]
