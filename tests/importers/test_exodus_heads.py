"""What Exodus files say of themselves, without VTK: damaged heads, kinds of elements, groups, unwritten values."""

import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
from exodus_made import ELEMENTS, POINTS, UNWRITTEN, Netcdf, attribute, exodus, listed, text

from ast_sim.importers.formats.exodus.exodus_files import exodus_facts, node_numbers, require_whole_exodus
from ast_sim.importers.formats.exodus.exodus_groups import groups_in
from ast_sim.importers.formats.exodus.exodus_pieces import is_first_piece, is_piece
from ast_sim.importers.formats.exodus.netcdf_head import read_netcdf_head
from ast_sim.importers.formats.exodus.unwritten import with_nan, written_time
from ast_sim.importers.frames_in_file import holds_frames
from ast_sim.importers.solids.kept_frames import KeptFrames
from ast_sim.support.errors import DatasetError

CUT_OFF = "a.e: is cut off or damaged"


def head(*variables, dimensions=(("n", 3),), records=b"\0\0\0\0", version=2):
    """The bytes of a head; each variable as its name, the numbers of its dimensions, its kind and where it begins."""
    entries = [
        text(name, ">i")
        + struct.pack(f">i{len(of)}i", len(of), *of)
        + listed(12, [], ">i")
        + struct.pack(">iiq", kind, 0, begin)
        for name, of, kind, begin in variables
    ]
    lengths = [text(name, ">i") + struct.pack(">i", length) for name, length in dimensions]
    start = b"CDF" + bytes([version]) + records
    return start + listed(10, lengths, ">i") + listed(12, [], ">i") + listed(11, entries, ">i")


def test_heads_that_name_what_is_not_there_are_refused(tmp_path):
    path = tmp_path / "a.e"
    cases = {
        "x has a dimension that is not there": head(("x", [1], 5, 0)),
        "there is no kind of number 12": head(("x", [0], 12, 0)),
        "there is no kind of number 0": head(("x", [0], 0, 0)),
        "x begins at -8": head(("x", [0], 5, -8)),
        "the count -3 is negative": head(("x", [0], 5, 0), dimensions=(("n", -3),)),
        "the head is cut off": head(("x", [0], 5, 0))[:-3],
    }
    for cause, content in cases.items():
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"^{cause}$"):
            read_netcdf_head(path)
        with pytest.raises(DatasetError, match=CUT_OFF):
            exodus_facts(path)
    path.write_bytes(head(("x", [0], 5, 0))[:40] + struct.pack(">i", 1 << 30))  # no memory for a text of 1 GiB
    with pytest.raises(ValueError, match="^the head is cut off$"):
        read_netcdf_head(path)


def test_a_length_that_no_memory_holds_is_refused(tmp_path):
    (tmp_path / "a.e").write_bytes(b"CDF\5" + bytes(8) + struct.pack(">iqq", 10, 1, 1 << 62))
    with pytest.raises(DatasetError, match=CUT_OFF):
        exodus_facts(tmp_path / "a.e")


def test_heads_of_each_kind_say_the_same(tmp_path):
    facts = []
    for version in (1, 2, 5):
        exodus().write(tmp_path / "a.e", version)
        assert read_netcdf_head(tmp_path / "a.e").needed == (tmp_path / "a.e").stat().st_size
        facts.append(exodus_facts(tmp_path / "a.e"))
    assert facts[0] == facts[1] == facts[2] and facts[0].steps == 3 and facts[0].timed


def test_the_bytes_that_a_file_must_have_are_counted(tmp_path):
    """Records are filled up to whole words, but not if there is one variable of records alone."""
    path = tmp_path / "a.e"
    dimensions = (("t", 0), ("n", 3))
    start = 1000
    cases = [
        ([("x", [0, 1], 1, start)], 4, start + 12),
        ([("x", [0, 1], 1, start), ("y", [0, 1], 1, start + 4)], 4, start + 4 + 3 * 8 + 3),
        ([("x", [0, 1], 1, start)], 0, 0),
        ([("x", [1], 6, start)], 0, start + 24),
        ([], 0, 0),
    ]
    for variables, records, needed in cases:
        path.write_bytes(head(*variables, dimensions=dimensions, records=struct.pack(">i", records)))
        assert read_netcdf_head(path).needed == needed
    path.write_bytes(head(("x", [0, 1], 1, start), dimensions=dimensions, records=b"\xff" * 4))
    known = read_netcdf_head(path)
    assert known.records is None and known.needed == 0  # a program still writes it
    assert exodus_facts(path).steps == 0
    path.write_bytes(head(("x", [0, 0, 0], 6, start), dimensions=(("n", 1 << 30),)))
    assert read_netcdf_head(path).needed == start + 8 * (1 << 90)  # no overflow
    with pytest.raises(DatasetError, match=f"{CUT_OFF}: the file is shorter than it says"):
        exodus_facts(path)


def test_texts_alone_are_kept_of_attributes(tmp_path):
    path = tmp_path / "a.e"
    entry = text("x", ">i") + struct.pack(">ii", 1, 0)
    entry += listed(12, [attribute("one", np.int32(7), ">i"), attribute("elem_type", "HEX", ">i")], ">i")
    entry += struct.pack(">iiq", 5, 0, 0)
    lengths = [text("n", ">i") + struct.pack(">i", 3)]
    path.write_bytes(b"CDF\2\0\0\0\0" + listed(10, lengths, ">i") + listed(12, [], ">i") + listed(11, [entry], ">i"))
    assert read_netcdf_head(path).variables["x"].attrs == {"elem_type": b"HEX"}
    path.write_bytes(head(("x", [0], 5, 0)).replace(b"\0\0\0\1x", b"\0\0\0\1\xfc"))  # a name that is no UTF-8
    assert list(read_netcdf_head(path).variables) == ["\ufffd"]


def test_values_that_do_not_fit_their_names_are_damage(tmp_path):
    path = tmp_path / "a.e"
    scalar = exodus()
    scalar.put("name_nod_var", (), np.frombuffer(b"x", "S1"))
    without = exodus()
    without.put("connect1", (), np.array([1], "i4"), elem_type="TETRA4")
    moving = exodus(times=(), values={})
    moving.put("eb_prop1", ("time_step", "num_nodes"), np.zeros((0, len(POINTS)), "i4"), name="ID")
    moving.variables["eb_prop1"] = moving.variables.pop("eb_prop1")  # at the end, where there are no records
    for made, cause in ((scalar, "tuple index out of range"), (without, "tuple index"), (moving, "cannot reshape")):
        made.write(path)
        with pytest.raises(DatasetError, match=f"{CUT_OFF}: {cause}"):
            exodus_facts(path)


def test_what_is_neither_kind_is_left_to_vtk(tmp_path):
    (tmp_path / "a.g").write_bytes(b"what is this?")
    assert exodus_facts(tmp_path / "a.g") is None and require_whole_exodus(tmp_path / "a.g") is None
    assert not holds_frames(tmp_path / "a.g")


def test_hdf_that_is_damaged_is_refused_by_name(tmp_path):
    path = tmp_path / "a.e"
    made = exodus(numbers=1 + np.arange(len(POINTS)))
    made.write_hdf(path)
    facts = exodus_facts(path)
    assert facts.kinds == [("TETRA4", 4)] * 2 and facts.steps == 3 and facts.ids == [1, 2] and facts.texts == []
    assert node_numbers(path).tolist() == list(range(1, 1 + len(POINTS)))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    for look in (exodus_facts, node_numbers):
        with pytest.raises(DatasetError, match="a.e: "):
            look(path)


@pytest.mark.parametrize("hdf", [False, True])
def test_what_a_file_may_lack(tmp_path, hdf):
    path = tmp_path / "a.e"

    def written(made):
        made.write_hdf(path) if hdf else made.write(path)
        return path

    made = exodus()
    for name in ("eb_prop1", "name_nod_var", "vals_nod_var3"):
        del made.variables[name]
    facts = exodus_facts(written(made))
    assert facts.ids == [] and facts.lacking == "" and facts.steps == 3
    with pytest.raises(DatasetError, match=r"a.e: gives its nodes no numbers \(node_num_map\)"):
        node_numbers(path)
    made = exodus()
    for number in (1, 2, 3):
        del made.variables[f"vals_nod_var{number}"]
    assert exodus_facts(written(made)).lacking == "vals_nod_var1"
    made.dimensions["num_nod_var"] = 3  # one array for all, as old programs write them
    made.put("vals_nod_var", ("time_step", "num_nod_var", "num_nodes"), np.zeros((3, 3, len(POINTS))))
    assert exodus_facts(written(made)).lacking == ""
    made = exodus(times=())
    for number in (1, 2, 3):
        del made.variables[f"vals_nod_var{number}"]
    assert exodus_facts(written(made)).lacking == ""  # no frame, no values
    made = Netcdf({"time_step": 0})
    made.put("time_whole", ("time_step",), np.zeros(0))
    assert exodus_facts(written(made)).steps == 0


def test_texts_of_any_length_are_told_wherever_vtk_reads_them(tmp_path):
    for where in ("title", "elem_type of connect1", ""):
        exodus().write_hdf(tmp_path / "a.e")
        with h5py.File(tmp_path / "a.e", "r+") as file:
            file.attrs["other"] = "Prüfung"
            if where == "title":
                file.attrs["title"] = "Prüfung"
            elif where:
                file["connect1"].attrs["elem_type"] = "TETRA4"
        assert exodus_facts(tmp_path / "a.e").texts == ([where] if where else [])
        assert exodus_facts(tmp_path / "a.e").kinds[0] == ("TETRA4", 4)


@pytest.mark.parametrize(
    ("kind", "nodes", "right"),
    [
        ("TRI3", 3, "3 or 6"),
        ("quad", 4, "4, 8 or 9"),
        ("SHELL4", 4, "3, 4 or 8"),
        ("tetra", 4, "4, 10 or 15"),
        ("PYRAMID", 5, "5 or 13"),
        ("WEDGE", 6, "6, 15, 18 or 21"),
        ("Hex", 8, "8, 20 or 27"),
    ],
)
def test_each_kind_has_the_numbers_of_nodes_that_vtk_knows(tmp_path, kind, nodes, right):
    path = tmp_path / "a.e"
    for count in range(1, 30):
        cells = np.arange(count)[None]
        exodus(np.zeros((30, 3)), [(kind, 1, "a", cells)], {}, times=(), node_sets=()).write(path)
        if str(count) in right.replace(",", "").split():
            require_whole_exodus(path)
            continue
        cause = f"a.e: holds {kind} elements of {count} nodes, and VTK mistakes .*: write them with {right} nodes"
        with pytest.raises(DatasetError, match=cause):
            require_whole_exodus(path)
    exodus(np.zeros((30, 3)), [("SPHERE", 1, "a", np.arange(17)[None])], {}, times=(), node_sets=()).write(path)
    require_whole_exodus(path)  # of a kind that is not known here, VTK knows more


def test_a_kind_may_end_in_spaces_or_zeros(tmp_path):
    for kind in ("TETRA4\0\0", "TETRA4  ", " TETRA4"):
        exodus(blocks=[(kind, 1, "pad", ELEMENTS[0])], node_sets=()).write(tmp_path / "a.e")
        assert exodus_facts(tmp_path / "a.e").kinds == [("TETRA4", 4)]
    exodus(blocks=[(" \0", 1, "pad", ELEMENTS[0])], node_sets=()).write(tmp_path / "a.e")
    with pytest.raises(DatasetError, match="does not say of which kind a block is"):
        require_whole_exodus(tmp_path / "a.e")


def test_results_that_go_on_in_another_file_are_refused(tmp_path):
    exodus().write(tmp_path / "job.e")
    require_whole_exodus(tmp_path / "job.e")
    (tmp_path / "job.e-s003").write_bytes(b"")
    (tmp_path / "job.e-s002").write_bytes(b"")
    with pytest.raises(DatasetError, match="job.e: goes on in job.e-s002 with another mesh; the mesh must not change"):
        require_whole_exodus(tmp_path / "job.e")


def parts(*held):
    return [{key: np.array(value) for key, value in one.items()} for one in held]


def test_groups_of_parts(tmp_path):
    """Blocks have the numbers of their nodes; parts without cells have none. Names may be of any letters."""
    given = parts(
        {"block": b"/Elements/K\xf6rper", "global": [3, 1, 2]},
        {"block": b"/Elements/empty"},
        {"global": [4]},
        {"block": b"/Elements/a", "global": [0]},
        {"block": b"/Elements/a", "global": [1, 0]},
        {"group nodes low": [2, 0, 2]},
        {"group sides low": [0, 2]},
    )
    groups, notes = groups_in(tmp_path / "a.e", given, 4)
    assert {name: ids.tolist() for name, ids in groups.items()} == {
        "low": [0, 2],
        "K\ufffdrper": [1, 2, 3],
        "a": [0, 1],
    }
    assert notes == []  # blocks of one name, and sets of the same nodes, are nothing to tell


@pytest.mark.parametrize("kind", ["nodes", "sides"])
def test_nodes_of_sets_are_numbered_from_1_to_the_last(tmp_path, kind):
    for node in (0, 3):
        groups_in(tmp_path / "a.e", parts({f"group {kind} low": [node]}), 4)
    for node in (-1, 4, 99):
        cause = f"a.e: the set of {kind} 'low' has the node {node + 1}, but the nodes are 1 to 4"
        with pytest.raises(DatasetError, match=cause):
            groups_in(tmp_path / "a.e", parts({f"group {kind} low": [1, node]}), 4)
    groups_in(tmp_path / "a.e", parts({"block": b"/a", "global": [7]}), 4)  # elements are checked where they are read


def test_numbers_that_were_never_written_are_told_by_row():
    vector = np.arange(12.0).reshape(4, 3)
    vector[1, :2] = vector[3] = UNWRITTEN
    single = np.array([1, UNWRITTEN], np.float32)
    number = np.array([1, 2])
    given = [{"point u": vector, "cell s": single, "block": number}, {"point u": vector[:2], "points": vector[:1]}]
    kept, notes = with_nan(given)
    assert notes == [
        "the field 'u' was never written at 3 rows: it is NaN there",
        "the field 's' was never written at 1 row: it is NaN there",
    ]
    assert np.isnan(kept[0]["point u"]).sum(axis=1).tolist() == [0, 2, 0, 3] and np.isnan(kept[0]["cell s"][1])
    assert kept[0]["block"] is number and given[0]["point u"] is vector  # what was given is as it was
    vector[0, 0] = UNWRITTEN
    assert with_nan([{"points": vector}])[1] == ["the field 'points' was never written at 3 rows: it is NaN there"]
    assert np.isnan(written_time(UNWRITTEN)) and written_time(None) is None and written_time(2.5) == 2.5


def test_the_names_of_pieces():
    names = {
        "job.e.4.0": (True, True),
        "JOB.EXO.12.00": (True, True),
        "job.e.4.1": (True, False),
        "job.g.10.10": (True, False),
    }
    names |= {
        "job.e": (False, False),
        "job.vtu.4.0": (False, False),
        "job.e.4": (False, False),
        "e.4.0": (False, False),
    }
    for name, (piece, first) in names.items():
        assert (is_piece(Path(name)), is_first_piece(Path(name))) == (piece, first), name


def test_zeros_in_the_last_frame_are_told_where_they_may_be_unwritten():
    zero = np.zeros((2, 3))
    moved = zero + 1
    told = ["in the last frame all displacements are 0 again: was the run stopped while it wrote this frame?"]
    cases = [
        ([zero, moved, zero], [], told),
        ([zero, moved, moved], [], []),
        ([zero, zero, zero], [], []),  # at rest before
        ([moved, zero], [], []),
        ([None, zero, moved, zero], [], []),  # the first frame has no field
        ([zero, moved, zero], [moved, moved, zero], told),
        ([zero, moved, zero], [zero, moved, moved], []),  # a stress that stays
    ]
    for displacements, stresses, notes in cases:
        kept = KeptFrames(displacements=displacements, stresses=stresses)
        assert kept.doubts_of_end() == notes
