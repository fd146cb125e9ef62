"""Importing MeshGraphNets data: what comes out, and every way in which a meta.json or a record does not fit."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from deepmind_samples import COUNTS, FAMILIES, FRAMES, example, frame, meta, records, write

from ast_sim.cli import main
from ast_sim.dataset.reader import Dataset
from ast_sim.importers.deepmind import convert_deepmind, read_trajectories
from ast_sim.importers.deepmind_meta import read_meta
from ast_sim.scene import NodeType, Trajectory
from ast_sim.support.errors import DatasetError

BY_TENSORFLOW = Path(__file__).parent / "deepmind"


def first(folder: Path, split="train") -> Trajectory:
    return next(read_trajectories(folder / f"{split}.tfrecord", read_meta(folder / "meta.json")))


def written(folder: Path, family: str, arrays: dict, changes: dict | None = None) -> Path:
    """A folder of a family whose training file holds these arrays instead."""
    folder = write(folder, family, changes)
    (folder / "train.tfrecord").write_bytes(frame(example(arrays)))
    return folder


def features(family: str, **changes) -> dict:
    """`features` of its meta.json; a change is a type, shape, dtype, or None for none."""
    found = {**meta(family)["features"], **changes}
    return {name: value for name, value in found.items() if value is not None}


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("writer", ["TensorFlow", "the definition"])
def test_arrays_arrive_as_they_were_written(tmp_path, family, writer):
    source = BY_TENSORFLOW / family if writer == "TensorFlow" else write(tmp_path, family)
    assert convert_deepmind(source, tmp_path / "d.h5") == {**COUNTS, "calibration": 0}
    with Dataset(tmp_path / "d.h5") as dataset:
        assert dataset.splits == {**COUNTS, "calibration": 0}
        for split in COUNTS:
            for index, wanted in enumerate(records(family, split)):
                found = dataset.load(split, index)
                assert np.array_equal(found.position, wanted["world_pos"])
                assert np.array_equal(found.scene.elements, wanted["cells"][0])
                assert np.array_equal(found.scene.node_type, wanted["node_type"][0, :, 0])
                assert found.attributes == {"status": "complete", "source": f"{split}.tfrecord", "index": index}
                if family == "deforming_plate":
                    assert np.array_equal(found.stress, wanted["stress"])
                    assert np.array_equal(found.scene.rest_position, wanted["mesh_pos"][0])
                else:
                    assert found.stress is None


def test_the_files_of_tensorflow_are_not_ours(tmp_path):
    """The two writers agree in what they say, not in their bytes: TensorFlow orders the features in its own way."""
    for family in FAMILIES:
        ours = (write(tmp_path, family) / "train.tfrecord").read_bytes()
        assert (BY_TENSORFLOW / family / "train.tfrecord").read_bytes() != ours
        assert json.loads((BY_TENSORFLOW / family / "meta.json").read_text()) == meta(family)


def test_cloth_rests_flat_and_the_sphere_where_it_starts(tmp_path):
    arrays = records("sphere_simple", "train")[0]
    scene = first(write(tmp_path, "sphere_simple")).scene
    sphere = scene.node_type == NodeType.OBSTACLE
    assert sphere.sum() == 6 and scene.body.tolist() == [0] * (~sphere).sum() + [1] * 6
    assert np.array_equal(scene.rest_position[~sphere, :2], arrays["mesh_pos"][0, ~sphere])
    assert (scene.rest_position[~sphere, 2] == 0).all() and scene.node_type[0] == NodeType.HANDLE
    assert np.array_equal(scene.rest_position[sphere], arrays["world_pos"][0, sphere])


def test_a_sphere_of_handles_is_rigid_and_an_obstacle_in_a_sheet_is_cloth(tmp_path):
    arrays = records("sphere_simple", "train")[0]
    kinds = arrays["node_type"].copy()
    kinds[0, -6:], kinds[0, 0] = 3, 1
    scene = first(written(tmp_path, "sphere_simple", {**arrays, "node_type": kinds})).scene
    assert np.array_equal(scene.rest_position[-6:], arrays["world_pos"][0, -6:])
    assert np.array_equal(scene.rest_position[0], [*arrays["mesh_pos"][0, 0], 0])


@pytest.mark.parametrize("family", FAMILIES)
def test_the_dataset_says_what_the_meta_file_says(tmp_path, family):
    source = write(tmp_path, family)
    convert_deepmind(source, tmp_path / "d.h5")
    points = np.concatenate([a["world_pos"].reshape(-1, 3) for split in COUNTS for a in records(family, split)])
    with Dataset(tmp_path / "d.h5") as dataset:
        info = dataset.info
    plate = family == "deforming_plate"
    assert (info.family, info.length_unit) == (family, "m")
    assert (info.integration, info.time_step) == (("quasi_static", 0.0) if plate else ("dynamic", 0.01))
    assert (info.stress_location, info.contact_radius) == (("node", 0.03) if plate else ("none", 0.05))
    assert info.domain_center == pytest.approx((points.min(0) + points.max(0)) / 2, abs=1e-6)
    assert info.domain_half_width == pytest.approx(0.6 * np.ptp(points, axis=0).max(), rel=1e-6)
    assert info.generator["simulator"] == ("comsol" if plate else "arcsim")


def test_splits_limit_and_every(tmp_path):
    source = write(tmp_path, "sphere_simple")
    told = []
    tell = lambda done, total, line: told.append((done, total, line))  # noqa: E731
    counts = convert_deepmind(source, tmp_path / "d.h5", splits=["test", "train"], limit=2, every=3, progress=tell)
    assert counts == {"train": 2, "valid": 0, "test": 2, "calibration": 0}
    assert told[0] == (1, 4, "train: train.tfrecord 0, 3 frames of 18 nodes") and len(told) == 4
    with Dataset(tmp_path / "d.h5") as dataset:
        assert dataset.info.time_step == pytest.approx(0.03)
        for split in ("train", "test"):
            for index in range(2):
                wanted = records("sphere_simple", split)[index]["world_pos"][[0, 3, 6]]
                assert np.array_equal(dataset.load(split, index).position, wanted)
    convert_deepmind(source, tmp_path / "one.h5", every=FRAMES)
    with Dataset(tmp_path / "one.h5") as dataset:
        assert dataset.num_frames("train", 0) == 1


def test_files_that_are_not_there(tmp_path):
    source = write(tmp_path, "deforming_plate")
    (source / "valid.tfrecord").unlink()
    assert convert_deepmind(source, tmp_path / "d.h5") == {**COUNTS, "valid": 0, "calibration": 0}
    with pytest.raises(DatasetError, match=f"{source}/valid.tfrecord: there is no such file"):
        convert_deepmind(source, tmp_path / "e.h5", splits=["train", "valid"])
    (source / "train.tfrecord").write_bytes(b"")
    with pytest.raises(DatasetError, match=f"{source}/train.tfrecord: is empty"):
        convert_deepmind(source, tmp_path / "e.h5")
    (source / "meta.json").unlink()
    with pytest.raises(DatasetError, match=f"{source}/meta.json is missing"):
        convert_deepmind(source, tmp_path / "e.h5")
    (source / "train.tfrecord").unlink()
    (source / "test.tfrecord").unlink()
    with pytest.raises(DatasetError, match="holds none of train.tfrecord, valid.tfrecord, test.tfrecord"):
        convert_deepmind(source, tmp_path / "e.h5")
    assert sorted(os.listdir(tmp_path)) == ["d.h5", "deforming_plate"]


def test_a_mesh_that_is_stored_for_every_frame(tmp_path):
    """Static features may also be repeated for each frame, or be of varying length that does not vary."""
    arrays, length = records("deforming_plate", "train")[0], np.full(FRAMES, 0, "<i4")
    repeated = {name: np.repeat(arrays[name], FRAMES, axis=0) for name in ("cells", "node_type")}
    flat = {"mesh_pos": np.tile(arrays["mesh_pos"][0], (FRAMES, 1)), "world_pos": arrays["world_pos"].reshape(-1, 3)}
    lengths = {f"length_{name}": length + arrays["world_pos"].shape[1] for name in flat}
    changes = features(
        "deforming_plate",
        cells={"type": "dynamic", "shape": [FRAMES, -1, 4], "dtype": "int32"},
        node_type={"type": "dynamic", "shape": [FRAMES, -1, 1], "dtype": "int32"},
        **{name: {"type": "dynamic_varlen", "shape": [-1, 3], "dtype": "float32"} for name in flat},
    )
    names = [*changes, *lengths]
    given = {**arrays, **repeated, **flat, **lengths}
    found = first(written(tmp_path, "deforming_plate", given, {"features": changes, "field_names": names}))
    wanted = first(write(tmp_path / "static", "deforming_plate"))
    for name in ("elements", "node_type", "rest_position", "body"):
        assert np.array_equal(getattr(found.scene, name), getattr(wanted.scene, name))
    assert np.array_equal(found.position, wanted.position)


def test_rest_coordinates_for_every_frame_may_be_undefined_on_the_sphere(tmp_path):
    arrays = records("sphere_simple", "train")[0]
    changes = features("sphere_simple", mesh_pos={"type": "dynamic", "shape": [FRAMES, -1, 2], "dtype": "float32"})
    given = {**arrays, "mesh_pos": np.repeat(arrays["mesh_pos"], FRAMES, axis=0)}
    found = first(written(tmp_path, "sphere_simple", given, {"features": changes}))
    wanted = first(write(tmp_path / "static", "sphere_simple"))
    assert np.isnan(given["mesh_pos"]).any() and np.array_equal(found.scene.rest_position, wanted.scene.rest_position)


def test_a_folder_with_a_meta_file_of_another_kind_is_a_series(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "meta.json").write_text("{}")
    assert main(["convert", str(tmp_path / "run"), "--out", str(tmp_path / "d.h5")]) == 2
    assert "neither the folder nor a folder in it holds files of results: .pvd" in capsys.readouterr().err


def test_a_mesh_that_changes_is_refused(tmp_path):
    arrays = records("deforming_plate", "train")[0]
    repeated = np.repeat(arrays["cells"], FRAMES, axis=0)
    repeated[5, 0] = repeated[5, 1]
    changes = features("deforming_plate", cells={"type": "dynamic", "shape": [FRAMES, -1, 4], "dtype": "int32"})
    source = written(tmp_path, "deforming_plate", {**arrays, "cells": repeated}, {"features": changes})
    with pytest.raises(DatasetError, match="record 0: cells in frame 5 differs from frame 0: the mesh changes, but"):
        convert_deepmind(source, tmp_path / "d.h5")

    rows = len(arrays["cells"][0])
    given = {**arrays, "cells": repeated.reshape(-1, 4), "length_cells": np.full(FRAMES, rows, "<i4")}
    given["length_cells"][[2, 3]] += np.array([1, -1])
    changes["cells"] = {"type": "dynamic_varlen", "shape": [-1, 4], "dtype": "int32"}
    told = {"features": changes, "field_names": [*changes, "length_cells"]}
    source = written(tmp_path / "ragged", "deforming_plate", given, told)
    with pytest.raises(DatasetError, match=f"cells has {rows} rows in frame 0 and {rows + 1} in frame 2: the mesh"):
        convert_deepmind(source, tmp_path / "d.h5")
    del given["length_cells"]
    with pytest.raises(DatasetError, match="record 0: has no feature length_cells, which meta.json lists"):
        convert_deepmind(written(tmp_path / "none", "deforming_plate", given, told), tmp_path / "d.h5")
    for wrong in (np.full(FRAMES, -1, "<i4"), np.full(FRAMES, 2**31 - 1, "<i4")):
        source = written(tmp_path / str(wrong[0]), "deforming_plate", {**given, "length_cells": wrong}, told)
        with pytest.raises(DatasetError, match=f"length_cells does not add up to the {FRAMES * rows} rows of cells"):
            convert_deepmind(source, tmp_path / "d.h5")


@pytest.mark.parametrize("width", [3, 4])
@pytest.mark.parametrize("dtype", ["float32", "<dtype: 'float32'>"])
def test_both_spellings_of_the_sizing_field(tmp_path, width, dtype):
    """It is not read, so it does not matter that the data have three columns, whatever the meta.json says."""
    arrays = records("sphere_simple", "train")[0]
    given = {**arrays, "sizing_field": np.zeros((5, 3), "<f4"), "length_sizing_field": np.zeros(FRAMES, "<i4")}
    changes = features("sphere_simple", sizing_field={"type": "dynamic_varlen", "shape": [-1, width], "dtype": dtype})
    told = {"features": changes, "field_names": [*changes, "length_sizing_field"]}
    source = written(tmp_path, "sphere_simple", given, told)
    assert np.array_equal(first(source).position, arrays["world_pos"])


def test_wider_numbers_become_ours(tmp_path):
    arrays = records("deforming_plate", "train")[0]
    wide = {"cells": "int64", "node_type": "uint8", "mesh_pos": "float64", "world_pos": "float64"}
    given = {**arrays, **{name: arrays[name].astype(dtype) for name, dtype in wide.items()}}
    changes = features("deforming_plate")
    for name, dtype in wide.items():
        changes[name]["dtype"] = dtype
    found = first(written(tmp_path, "deforming_plate", given, {"features": changes}))
    wanted = first(write(tmp_path / "usual", "deforming_plate"))
    assert np.array_equal(found.position, wanted.position) and found.position.dtype == np.float32
    for name in ("rest_position", "elements", "node_type"):
        one, other = getattr(found.scene, name), getattr(wanted.scene, name)
        assert one.dtype == other.dtype and np.array_equal(one, other)
    given["cells"][0, 0, 0] = 1 << 40
    with pytest.raises(DatasetError, match="record 0: cells holds 1099511627776; must be from -2147483648 to"):
        first(written(tmp_path / "large", "deforming_plate", given, {"features": changes}))
    given["world_pos"][2, 1, 0] = 1e300
    given["cells"][0, 0, 0] = 0
    source = written(tmp_path / "far", "deforming_plate", given, {"features": changes})
    with pytest.raises(DatasetError, match="position in frame 2 at node 1 is not finite"):
        convert_deepmind(source, tmp_path / "d.h5")


def changed(name: str, change) -> dict[str, np.ndarray]:
    arrays = dict(records("deforming_plate", "train")[0])
    arrays[name] = change(arrays[name].copy())
    return arrays


def put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


WRONG_RECORDS = {
    "type 2": (changed("node_type", put((0, 5), 2)), "node 5 has the type 2; known are 0 NORMAL, 1 OBSTACLE, 3 HANDLE"),
    "type 256": (changed("node_type", put((0, 5), 256)), "node_type holds 256; must be from 0 to 255"),
    "a cell beyond": (changed("cells", put((0, 3, 1), 99)), "element 3 refers to node 99, but the nodes are 0 to 23"),
    "a negative cell": (changed("cells", put((0, 3, 1), -1)), "element 3 refers to node -1"),
    "a flat cell": (changed("cells", put((0, 3), 2)), "element 3 refers to a node twice"),
    "not finite": (changed("world_pos", put((4, 3, 2), np.nan)), "position in frame 4 at node 3 is not finite"),
    "stress not finite": (changed("stress", put((4, 3), np.inf)), "stress in frame 4 at node 3 is not finite"),
    "rest not finite": (changed("mesh_pos", put((0, 3), np.inf)), "rest_position of node 3 is not finite"),
    "fewer types": (changed("node_type", lambda a: a[:, 1:]), r"node_type has the shape \[23\], must be \[24\]"),
    "fewer rest": (changed("mesh_pos", lambda a: a[:, 1:]), r"mesh_pos has the shape \[23, 3\], must be \[24, any\]"),
    "fewer stress": (changed("stress", lambda a: a[:, 1:]), "stress has 23 rows; needs 24"),
    "no nodes": (
        {name: array[:, :0] for name, array in records("deforming_plate", "train")[0].items()},
        "a scene needs nodes and elements, this one has 0 and 0",
    ),
    "a frame less": (changed("world_pos", lambda a: a[:-1]), r"mesh_pos has the shape \[24, 3\], must be \[21, any\]"),
    "a number less": (
        changed("world_pos", lambda a: a.ravel()[:-1]),
        r"world_pos has 2,300 bytes; meta.json says float32 \[8, -1, 3\], a multiple of 96 bytes",
    ),
    "half a cell": (changed("cells", lambda a: a.ravel()[:-1]), "cells has 380 bytes; .* a multiple of 16 bytes"),
}


@pytest.mark.parametrize("case", WRONG_RECORDS)
def test_a_wrong_record_is_named(tmp_path, case):
    arrays, message = WRONG_RECORDS[case]
    source = written(tmp_path, "deforming_plate", arrays)
    with pytest.raises(DatasetError, match=message) as error:
        convert_deepmind(source, tmp_path / "d.h5")
    assert "\n" not in str(error.value) and os.listdir(tmp_path) == ["deforming_plate"]


def test_a_missing_feature_is_named(tmp_path):
    arrays = records("deforming_plate", "train")[0]
    del arrays["stress"]
    source = written(tmp_path, "deforming_plate", arrays)
    with pytest.raises(DatasetError, match="train.tfrecord: record 0: has no feature stress, which meta.json lists"):
        convert_deepmind(source, tmp_path / "d.h5")


PLATE = features("deforming_plate")
WRONG_METAS = {
    "no dt": ({"dt": None}, "dt is None; must be a number"),
    "dt below 0": ({"dt": -0.1}, "dt and collision_radius at least 0"),
    "dt not finite": ({"dt": float("nan")}, "dt is nan; must be a number"),
    "a huge radius": ({"collision_radius": 10**400}, "collision_radius is 1000.*; must be a number"),
    "a radius of text": ({"collision_radius": "0.03"}, "collision_radius is '0.03'; must be a number"),
    "no frames": ({"trajectory_length": 0}, "trajectory_length must be at least 1"),
    "half a frame": ({"trajectory_length": 8.5}, "trajectory_length is 8.5; must be a whole number"),
    "yes": ({"trajectory_length": True}, "trajectory_length is True; must be a whole number"),
    "another length": (
        {"trajectory_length": 9},
        r"world_pos is dynamic and has the shape \[8, -1, 3\]; must be \[9, -1, 3\] \(trajectory_length is 9\)",
    ),
    "no simulator": ({"simulator": 3}, "simulator is 3; must be a text"),
    "features listed": ({"features": ["cells"]}, "features is .'cells'.; must be an object"),
    "a feature of text": ({"features": {"cells": "int32"}}, "the feature cells: must be a JSON object, not 'int32'"),
    "no world_pos": ({"features": {"cells": PLATE["cells"]}}, "there is no feature node_type; deforming bodies have"),
    "a flow": (
        {"features": {name: PLATE[name] for name in ("cells", "node_type", "mesh_pos")}},
        "there is no feature world_pos; .* here are cells, node_type, mesh_pos",
    ),
}
WRONG_FEATURES = {
    "no dtype": ({"dtype": None}, "the feature cells: dtype is None; must be a text"),
    "half a number": ({"dtype": "float16"}, "the feature cells: dtype is 'float16'; must be one of int32"),
    "an object": ({"dtype": "object"}, "dtype is 'object'"),
    "real cells": ({"dtype": "float32"}, "the feature cells: dtype is 'float32'; must be one of int32, int64, uint8"),
    "another kind": ({"type": "sparse"}, "type is 'sparse'; must be one of static, dynamic, dynamic_varlen"),
    "no shape": ({"shape": []}, r"is static and has the shape \[\]; must be \[1, -1, 3 or 4\]"),
    "two unknown": ({"shape": [1, -1, -1]}, r"has the shape \[1, -1, -1\]; must be"),
    "a size of 0": ({"shape": [1, 0, 4]}, r"has the shape \[1, 0, 4\]; must be"),
    "a size of text": ({"shape": [1, "n", 4]}, r"has the shape \[1, 'n', 4\]; must be"),
    "too large": ({"shape": [1, -1, 1 << 70]}, r"has the shape \[1, -1, 1180591620717411303424\]; must be"),
    "five corners": (
        {"shape": [1, -1, 5]},
        r"the feature cells is static and has the shape \[1, -1, 5\]; must be \[1, -1, 3 or 4\]",
    ),
    "two sizes": ({"shape": [1, 4]}, r"the feature cells is static and has the shape \[1, 4\]; must be"),
    "static for two": ({"shape": [2, -1, 4]}, r"is static and has the shape \[2, -1, 4\]; must be \[1, "),
}


@pytest.mark.parametrize("case", [*WRONG_METAS, *WRONG_FEATURES])
def test_a_wrong_meta_file_is_named(tmp_path, case):
    if case in WRONG_METAS:
        changes, message = WRONG_METAS[case]
    else:
        change, message = WRONG_FEATURES[case]
        changes = {"features": {**PLATE, "cells": {**PLATE["cells"], **change}}}
    source = write(tmp_path, "deforming_plate", changes)
    with pytest.raises(DatasetError, match=message) as error:
        convert_deepmind(source, tmp_path / "d.h5")
    assert str(error.value).startswith(f"{source}/meta.json: ") and "\n" not in str(error.value)
    assert os.listdir(tmp_path) == ["deforming_plate"]


@pytest.mark.parametrize("name", ["world_pos", "stress"])
def test_what_moves_cannot_be_static(tmp_path, name):
    changes = {**PLATE, name: {**PLATE[name], "type": "static", "shape": [1, *PLATE[name]["shape"][1:]]}}
    source = write(tmp_path, "deforming_plate", {"features": changes})
    with pytest.raises(
        DatasetError, match=f"the feature {name}: type is 'static'; must be one of dynamic, dynamic_varlen"
    ):
        convert_deepmind(source, tmp_path / "d.h5")


TEXTS = {
    "nothing": b"",
    "half": b'{"simulator": "com',
    "a list": b"[]",
    "not UTF-8": b'{"a": "\xff"}',
    "deep": b"[" * 100_000,
    "digits": b'{"dt": ' + b"9" * 10_000 + b"}",
    "large": b" " * (1 << 20) + b"{}",
}


@pytest.mark.parametrize("case", TEXTS)
def test_a_damaged_meta_file_is_named(tmp_path, case):
    source = write(tmp_path, "deforming_plate")
    (source / "meta.json").write_bytes(TEXTS[case])
    with pytest.raises(DatasetError, match=f"{source}/meta.json: ") as error:
        convert_deepmind(source, tmp_path / "d.h5")
    assert len(str(error.value)) < 300 and str(error.value).count("meta.json: ") == 1


def test_a_meta_file_that_is_a_folder_is_named_once(tmp_path):
    source = write(tmp_path, "deforming_plate")
    (source / "meta.json").unlink()
    (source / "meta.json").mkdir()
    with pytest.raises(DatasetError) as error:
        convert_deepmind(source, tmp_path / "d.h5")
    assert str(error.value) == f"{source}/meta.json: cannot be read: Is a directory"


def test_from_the_command_line(tmp_path, capsys):
    out = str(tmp_path / "d.h5")
    assert main(["convert", str(BY_TENSORFLOW / "deforming_plate"), "--out", out]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[0] == "train: train.tfrecord 0, 8 frames of 24 nodes"
    assert shown[-1] == f"{out}: 3 train, 1 valid, 2 test" and len(shown) == 7
    assert main(["info", out, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["family"], found["stress_location"]) == ("deforming_plate", "node")
    assert {split: one["trajectories"] for split, one in found["splits"].items()} == COUNTS
    assert main(["info", out]) == 0
    assert "every trajectory has the right shapes" in capsys.readouterr().out

    options = ["--split", "train", "test", "--limit", "1", "--every", "2"]
    assert main(["convert", str(BY_TENSORFLOW / "sphere_simple"), "--out", out, "--overwrite", *options]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        "test: test.tfrecord 0, 4 frames of 18 nodes",
        f"{out}: 1 train, 0 valid, 1 test",
    ]


def test_options_and_sources_that_do_not_fit(tmp_path, capsys):
    plate = BY_TENSORFLOW / "deforming_plate"
    shutil.copytree(plate, tmp_path / "alone")
    (tmp_path / "alone" / "meta.json").unlink()
    (tmp_path / "vtu").mkdir()
    for arguments, message in [
        ([plate, "--dynamic"], f"--dynamic has no meaning for {plate}: its meta.json has the facts"),
        ([plate, "--stress", "s"], f"--stress has no meaning for {plate}: its meta.json has the facts"),
        ([tmp_path / "vtu", "--limit", "3"], "--limit has no meaning for"),
        ([plate / "train.tfrecord"], f"{plate}/train.tfrecord: name its folder, which must hold meta.json too"),
        ([tmp_path / "alone"], f"{tmp_path}/alone/meta.json is missing; it says what is in the records"),
    ]:
        assert main(["convert", *map(str, arguments), "--out", str(tmp_path / "d.h5")]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == ["alone", "vtu"]


def test_importing_needs_no_torch():
    program = "import ast_sim.importers.deepmind, sys; sys.exit('torch' in sys.modules or 'tensorflow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
