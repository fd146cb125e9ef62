"""The dataset file: exact round trip; whatever is damaged, hostile or full ends in one DatasetError."""

import os
import pickle
import random
import resource
import signal
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from data_samples import block, info, raised, sign, trajectory, write
from meshes import two_tetrahedra

from ast_sim.dataset import reader as dataset_file
from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import Trajectory
from ast_sim.support.byte_cache import array_bytes
from ast_sim.support.errors import DatasetError
from ast_sim.view.encode import encode_scene
from ast_sim.view.fields import fields

TESTS = Path(__file__).parents[1]


def some(stress="node") -> dict[str, list[Trajectory]]:
    material = np.arange(12, dtype=np.float32)
    return {
        "train": [
            trajectory(block(2, 1, 1, material[:, None]), 4, 1, stress, solve_seconds=[0.5, 0.25, 1e-9], note="größer"),
            trajectory(two_tetrahedra(material=material[:2, None]), 3, 2, stress, status="truncated"),
        ],
        "test": [trajectory(block(1, 1, 1, material[:6, None]), 2, 3, stress)],
    }


def require_equal(found: Trajectory, wanted: Trajectory):
    for name in ("rest_position", "elements", "node_type", "body", "material"):
        one, other = getattr(found.scene, name), getattr(wanted.scene, name)
        assert one.dtype == other.dtype and np.array_equal(one, other)
    assert np.array_equal(found.position, wanted.position)
    assert (found.stress is None) == (wanted.stress is None)
    if wanted.stress is not None:
        assert np.array_equal(found.stress, wanted.stress)
    assert found.attributes == {"status": "complete", **wanted.attributes}


@pytest.mark.parametrize("stress", ["none", "node", "element"])
def test_what_was_written_is_read(tmp_path, stress):
    given, generator = some(stress), {"program": "ast_sim", "seed": 3, "versions": {"numpy": "2"}}
    path = write(tmp_path / "new" / "d.h5", given, stress_location=stress, time_step=0.5, generator=generator)
    assert os.listdir(path.parent) == ["d.h5"]
    with Dataset(path) as dataset:
        assert dataset.info == info(stress_location=stress, time_step=0.5, generator=generator)
        assert dataset.splits == {"train": 2, "valid": 0, "test": 1, "calibration": 0} and dataset.count("train") == 2
        assert (dataset.material_width, dataset.element_size) == (1, 4)
        for split, members in given.items():
            for index, member in enumerate(members):
                assert dataset.num_frames(split, index) == member.num_frames
                require_equal(dataset.load(split, index), member)
                assert dataset.scene(split, index) is dataset.scene(split, index)


@pytest.mark.parametrize("cache_bytes", [1 << 30, 0])
def test_frames_are_slices_from_memory_or_from_disk(tmp_path, monkeypatch, cache_bytes):
    monkeypatch.setattr(dataset_file, "cache_bytes", lambda: cache_bytes)
    given = some()
    with Dataset(write(tmp_path / "d.h5", given, stress_location="node")) as dataset:
        wanted = given["train"][0]
        for start, stop in [(0, 4), (1, 3), (3, 4), (2, 2)]:
            position, stress = dataset.frames("train", 0, start, stop)
            assert np.array_equal(position, wanted.position[start:stop])
            assert np.array_equal(stress, wanted.stress[start:stop])
            with pytest.raises(ValueError, match="read-only"):
                position += 1
        again, _ = dataset.frames("train", 0, 0, 4)
        assert np.shares_memory(again, dataset.frames("train", 0, 0, 4)[0]) == (cache_bytes > 0)


@pytest.mark.parametrize("location", ["node", "element"])
def test_a_trajectory_knows_where_its_stress_is(tmp_path, location):
    """Shown where the file says, also in a scene of as many nodes as elements."""
    given = trajectory(block(2, 1, 1), 3, stress=location)
    with Dataset(write(tmp_path / "d.h5", {"train": [given]}, stress_location=location)) as dataset:
        found = dataset.load("train", 0)
    assert found.stress_at == location
    shown = fields(found)
    place, other = (shown.point, shown.cell) if location == "node" else (shown.cell, shown.point)
    assert np.array_equal(place["von_mises"], given.stress[:, :, 0]) and "von_mises" not in other
    assert encode_scene(found, np.arange(3))["stress"] == location


def test_scenes_that_were_not_used_for_longest_are_let_go(tmp_path, monkeypatch):
    given = {"train": [trajectory(block(2, 1, 1), 3, seed) for seed in range(4)]}
    one = array_bytes(given["train"][0].scene)
    monkeypatch.setattr(dataset_file, "cache_bytes", lambda: 2 * one)
    with Dataset(write(tmp_path / "d.h5", given)) as dataset:
        first = weakref.ref(dataset.scene("train", 0))
        dataset.scene("train", 1)
        assert first() is dataset.scene("train", 0)
        dataset.scene("train", 2)  # the second one has to go
        assert first() is dataset.scene("train", 0) and dataset._scenes.held == 2 * one
        for index in range(4):
            assert np.array_equal(dataset.scene("train", index).elements, given["train"][index].scene.elements)
            assert dataset._scenes.held <= 2 * one
        assert first() is None


def test_numbers_and_times_of_frames_travel_with_a_trajectory(tmp_path):
    """Frames 2 and 4 of a motion stay frames 2 and 4; times that follow from the time step are not stored."""
    whole = trajectory(block(2, 1, 1), 5)
    some = whole.select([4, 2])
    assert some.numbers == (2, 4) and np.array_equal(some.position, whole.position[[2, 4]])
    uneven = replace(whole, times=(0.0, 0.1, 0.3, 0.4, 2.0))
    members = {"train": [whole, some, uneven, uneven.select([1, 4])]}
    with Dataset(write(tmp_path / "d.h5", members, time_step=0.5)) as dataset:
        found = list(dataset["train"])
        assert [dataset.numbers("train", index) for index in range(4)] == [one.numbers for one in found]
    assert [one.numbers for one in found] == [(0, 1, 2, 3, 4), (2, 4), (0, 1, 2, 3, 4), (1, 4)]
    assert [one.times for one in found[1:]] == [(1.0, 2.0), (0.0, 0.1, 0.3, 0.4, 2.0), (0.1, 2.0)]
    assert found[0].times == (0.0, 0.5, 1.0, 1.5, 2.0) and found[0].length_unit == "m"
    with h5py.File(tmp_path / "d.h5") as file:
        assert not {"frames", "times"} & set(file["train/000000"].attrs)
    with Dataset(write(tmp_path / "copy.h5", {"train": found}, time_step=0.5)) as copy:
        assert [(one.numbers, one.times) for one in copy["train"]] == [(one.numbers, one.times) for one in found]
    assert (tmp_path / "copy.h5").read_bytes() == (tmp_path / "d.h5").read_bytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": (0, 1)}, "frames holds 2 numbers for 3 frames"),
        ({"frames": (0, 2, 2)}, r"frames must be whole numbers and ascend: \[0, 2, 2\]"),
        ({"frames": (-1, 0, 1)}, "frames starts at -1; the first frame of a motion is 0"),
        ({"times": (0.0, float("nan"), 1.0)}, "times must be finite and ascend"),
        ({"length_unit": "mm"}, "train/000000 has lengths in mm, the dataset in m"),
    ],
)
def test_wrong_numbers_of_frames_and_another_unit_are_refused(tmp_path, changes, message):
    with pytest.raises(DatasetError, match=message):
        write(tmp_path / "d.h5", {"train": [replace(trajectory(block(1, 1, 1), 3), **changes)]})


def test_a_copy_keeps_the_cauchy_stress(tmp_path):
    path, wanted = tensors(tmp_path)
    with Dataset(path) as dataset:
        copied = write(tmp_path / "copy.h5", {"train": list(dataset["train"])})
    with Dataset(copied) as dataset:
        assert np.array_equal(dataset["train"][0].cauchy_stress, wanted)
        assert dataset["train"][1].cauchy_stress is None
    assert copied.read_bytes() == path.read_bytes()


def tensors(tmp_path):
    """A file whose first trajectory has the Cauchy stress of its elements and whose second has none."""
    members = [trajectory(block(2, 1, 1), 4, 1, tensor=True), trajectory(block(2, 1, 1), 3, 2)]
    return write(tmp_path / "d.h5", {"train": members}), members[0].cauchy_stress


def test_cauchy_stress_is_read_by_frames_and_only_when_asked(tmp_path):
    path, wanted = tensors(tmp_path)
    with h5py.File(path) as file:
        stored = file["train/000000/cauchy_stress"]
        assert (stored.dtype.str, stored.shape, stored.chunks) == ("<f4", (4, 12, 6), (1, 12, 6))
        assert stored.fletcher32
    data = path.read_bytes()
    with Dataset(path) as dataset:
        assert np.array_equal(dataset.cauchy_stress("train", 0), wanted)
        assert np.array_equal(dataset.cauchy_stress("train", 0, 1, 3), wanted[1:3])
        assert not dataset.cauchy_stress("train", 0).flags.writeable
        assert dataset.cauchy_stress("train", 1) is None
        with pytest.raises(DatasetError, match="train/000000: frames 2 to 5 of 4 do not exist"):
            dataset.cauchy_stress("train", 0, 2, 5)
    start = data.index(wanted[2].tobytes())
    path.write_bytes(data[:start] + bytes([data[start] ^ 1]) + data[start + 1 :])
    with Dataset(path) as dataset:  # nothing else touches the damaged array
        assert dataset.load("train", 0).cauchy_stress is None
        with pytest.raises(DatasetError, match="train/000000/cauchy_stress cannot be read; the file is damaged"):
            dataset.cauchy_stress("train", 0, 0, 2)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda a: a[1:], r"train/000000/cauchy_stress has the shape \[3, 12, 6\], must be \[4, 12, 6\]"),
        (lambda a: a[:, :, :5], r"cauchy_stress has the shape \[4, 12, 5\]"),
        (lambda a: a.astype(float), "cauchy_stress is float64 with 3 axes; must be float32 with 3"),
        (lambda a: np.where(a == a[3, 7, 2], np.nan, a), "cauchy_stress in frame 3 at element 7 is not finite"),
    ],
)
def test_a_hostile_cauchy_stress_is_refused_by_name(tmp_path, edit, message):
    path, _ = tensors(tmp_path)
    with h5py.File(path, "r+") as file:
        overwrite(file["train/000000"], "cauchy_stress", edit(file["train/000000/cauchy_stress"][()]))
        sign(file)
    with Dataset(path) as dataset, pytest.raises(DatasetError, match=f"{path}: .*{message}"):
        dataset.cauchy_stress("train", 0)


def test_the_memory_of_a_hostile_cauchy_stress_is_bounded(tmp_path):
    path, _ = tensors(tmp_path)
    with h5py.File(path, "r+") as file:
        declare(file, "cauchy_stress", (1 << 40, 12, 6), "f4")
        sign(file)
    with Dataset(path) as dataset, pytest.raises(DatasetError, match="cauchy_stress declares the shape"):
        dataset.cauchy_stress("train", 0)


@pytest.mark.parametrize("array", ["rest_position", "node_type", "material", "position", "stress"])
def test_an_edit_is_noticed(tmp_path, array):
    """HDF5 writes new checksums for what it changes; the hash of the array stays what it was."""
    path = write(tmp_path / "d.h5", some(), stress_location="node")
    with h5py.File(path, "r+") as file:
        values = file["train/000001"][array]
        values[-1] = 0 if array == "node_type" else values[-1] * 1.01
    with Dataset(path) as dataset:
        dataset.load("train", 0)
        with pytest.raises(DatasetError, match=rf"{path}: train/000001/{array} is not what was written"):
            dataset.load("train", 1)


@pytest.mark.parametrize("edit", ["attribute", "array"])
def test_an_edited_trajectory_is_noticed(tmp_path, edit):
    path = write(tmp_path / "d.h5", some(), stress_location="node")
    with h5py.File(path, "r+") as file:
        if edit == "attribute":
            file["train/000001"].attrs["status"] = "complete"
        else:
            del file["train/000001/material"]
    with Dataset(path) as dataset, pytest.raises(DatasetError, match="train/000001 is not what was written"):
        dataset.load("train", 1)


def test_the_fingerprint_tells_any_number_from_another(tmp_path):
    def fingerprint(name, change=lambda members: None) -> str:
        members = some()
        change(members)
        with Dataset(write(tmp_path / name, members, stress_location="node")) as dataset:
            return dataset.fingerprint()

    def stress(members):
        members["test"][0].stress[1, 2, 0] += 1

    def node_type(members):
        scene = members["train"][1].scene
        types = scene.node_type.copy()
        types[0] = 3 - types[0]
        members["train"][1] = replace(members["train"][1], scene=replace(scene, node_type=types))

    found = [fingerprint("a.h5"), fingerprint("b.h5", stress), fingerprint("c.h5", node_type)]
    assert len(set(found)) == 3 and found[0] == fingerprint("d.h5")


def test_the_layout_is_the_documented_one(tmp_path):
    path = write(tmp_path / "d.h5", some("element"), stress_location="element")
    with h5py.File(path) as file:
        assert file.attrs["format"] == b"ast_sim" and file.attrs["version"] == 3
        assert sorted(file.attrs) == sorted(
            ["format", "version", "family", "integration", "stress_location", "domain_center", "domain_half_width"]
            + ["contact_radius", "time_step", "length_unit", "generator"]
        )
        group = file["train/000001"]
        layout = {name: (value.dtype.str, value.shape, value.chunks) for name, value in group.items()}
        assert layout == {
            "rest_position": ("<f4", (5, 3), (5, 3)),
            "elements": ("<i4", (2, 4), (2, 4)),
            "node_type": ("|u1", (5,), (5,)),
            "body": ("<i4", (5,), (5,)),
            "material": ("<f4", (2, 1), (2, 1)),
            "position": ("<f4", (3, 5, 3), (1, 5, 3)),
            "stress": ("<f4", (3, 2, 1), (1, 2, 1)),
        }
        assert all(value.fletcher32 for value in group.values())
        assert group.attrs["status"] == b"truncated" and group.attrs["seed"] == 2


def test_attributes_keep_their_kinds(tmp_path):
    values = {"text": "", "flag": True, "count": np.int64(3), "real": np.float32(0.5), "list": list(range(20000))}
    member = trajectory(two_tetrahedra(), 2, none=[], **values)
    with Dataset(write(tmp_path / "d.h5", {"valid": [member]})) as dataset:
        found = dataset.attributes("valid", 0)
    assert found == {"status": "complete", "seed": 0, "none": [], **values}
    assert type(found["count"]) is int and type(found["real"]) is float and type(found["list"]) is list


def test_an_attribute_of_another_kind_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="attribute extra is {'a': 1}"):
        write(tmp_path / "d.h5", {"train": [trajectory(two_tetrahedra(), 2, extra={"a": 1})]})
    assert os.listdir(tmp_path) == []


def test_an_unknown_unit_of_length_is_refused(tmp_path):
    for unit in ("m", "cm", "mm", "um", "in"):
        write(tmp_path / f"{unit}.h5", some(), stress_location="node", length_unit=unit)
    with pytest.raises(DatasetError, match="length_unit is 'parsec'; must be one of m, cm, mm, um, in"):
        write(tmp_path / "parsec.h5", some(), stress_location="node", length_unit="parsec")
    assert not (tmp_path / "parsec.h5").exists()


def test_a_wrong_trajectory_is_refused_and_nothing_stays(tmp_path):
    good = trajectory(two_tetrahedra(), 2)
    with_material = trajectory(two_tetrahedra(material=np.ones((2, 1), np.float32)), 2)
    nan = Trajectory(good.scene, np.full_like(good.position, np.nan))
    for members, message in [
        ([good, nan], "train/000001: position in frame 0 at node 0 is not finite"),
        ([good, with_material], "train/000001: has 4 nodes per element and 1 material column;"),
        ([trajectory(good.scene, 2, stress="node")], "stress_location is 'none'"),
    ]:
        with pytest.raises(DatasetError, match=message):
            write(tmp_path / "d.h5", {"train": members})
        assert os.listdir(tmp_path) == []
    with pytest.raises(DatasetError, match="no split 'training'"):
        write(tmp_path / "d.h5", {"training": [good]})
    for changes in ({"integration": "static"}, {"domain_half_width": 0.0}, {"domain_center": (0, 0, float("nan"))}):
        with pytest.raises(DatasetError, match="d.h5: "):
            write(tmp_path / "d.h5", {}, **changes)


def test_an_error_while_writing_leaves_the_old_file(tmp_path):
    path = write(tmp_path / "d.h5", some(), stress_location="node")
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), DatasetWriter(path, info()) as writer:
        writer.add("train", trajectory(two_tetrahedra(), 2))
        raise KeyboardInterrupt
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["d.h5"]
    write(path, {"valid": [trajectory(two_tetrahedra(), 2)]})
    with Dataset(path) as dataset:
        assert dataset.splits == {"train": 0, "valid": 1, "test": 0, "calibration": 0}


LARGE = """
import resource, signal, sys
sys.path.insert(0, sys.argv[1])
from data_samples import block, trajectory, write
from ast_sim.support.errors import DatasetError
if sys.argv[3] != "0":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]), int(sys.argv[3])))

def members():
    for index in range(int(sys.argv[4])):
        print("member", flush=True)
        yield trajectory(block(6, 6, 6), 40, seed=index)

try:
    write(sys.argv[2], {"train": members()})
except DatasetError as error:
    print("error:", error)
"""


def large_command(path, limit: int, count: int) -> list[str]:
    """A process that writes `count` trajectories of 165 kB to the path, no file above the limit (0: none)."""
    return [sys.executable, "-c", LARGE, str(TESTS), str(path), str(limit), str(count)]


def last_line_of_writing(path, limit=0) -> str:
    done = subprocess.run(large_command(path, limit, 8), capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.splitlines()[-1]


@pytest.mark.parametrize("limit", [1, 700, 5_000, 100_000, 1_000_000, 1_300_000])
def test_a_file_that_may_not_grow_is_one_clear_error(tmp_path, limit):
    old = write(tmp_path / "d.h5", some(), stress_location="node").read_bytes()
    assert last_line_of_writing(tmp_path / "d.h5", limit).startswith(f"error: {tmp_path / 'd.h5'}: cannot be written: ")
    assert os.listdir(tmp_path) == ["d.h5"] and (tmp_path / "d.h5").read_bytes() == old


def test_a_full_disk_is_one_clear_error(tmp_path):
    """A file system of 256 KiB where the system lets us mount one, else a limit on the size of files."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "none", str(folder)]
    mounted = os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0
    try:
        printed = last_line_of_writing(folder / "d.h5", 0 if mounted else 256 << 10)
        assert "cannot be written: [Errno" in printed and ("No space left" in printed) == mounted
        assert os.listdir(folder) == []
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


def test_a_folder_that_cannot_be_written_is_one_clear_error(tmp_path):
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(DatasetError, match="cannot be written"):
        write(tmp_path / "taken" / "d.h5", {})


def test_a_kill_leaves_the_old_file(tmp_path):
    path = write(tmp_path / "d.h5", some(), stress_location="node")
    old = path.read_bytes()
    process = subprocess.Popen(large_command(path, 0, 10**6), stdout=subprocess.PIPE)
    for _ in range(3):
        assert process.stdout.readline() == b"member\n"
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    process.stdout.close()
    assert path.read_bytes() == old


# Damaged and hostile files


def read_all(path) -> list[Trajectory]:
    with Dataset(path) as dataset:
        return [
            dataset.load(split, index) for split in ("train", "valid", "test") for index in range(dataset.count(split))
        ]


def test_every_truncation_is_an_error(tmp_path):
    data = write(tmp_path / "d.h5", some(), stress_location="node").read_bytes()
    path = tmp_path / "cut.h5"
    for size in [*range(0, 200, 7), *range(200, len(data), len(data) // 150), len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(DatasetError, match="cut.h5"):
            read_all(path)


FLIPS = """
import sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/dataset"]
from test_dataset import flip_and_read
flip_and_read(sys.argv[2], sys.argv[3], range(int(sys.argv[4]), int(sys.argv[5])))
print("done")
"""


def flip_and_read(good, path, seeds) -> dict[str, int]:
    """Flip one random bit per seed; each time the data are the same or it is a DatasetError that names the file."""
    with open(good, "rb") as stream:
        data = stream.read()
    wanted = read_all(good)
    counts = {"same": 0, "refused": 0}
    for seed in seeds:
        place = random.Random(seed).randrange(8 * len(data))
        changed = bytearray(data)
        changed[place // 8] ^= 1 << place % 8
        with open(path, "wb") as stream:
            stream.write(changed)
        try:
            found = read_all(path)
        except DatasetError as error:
            assert str(path) in str(error) and "\n" not in str(error), error
            counts["refused"] += 1
        else:
            assert len(found) == len(wanted), place
            for one, other in zip(found, wanted, strict=True):
                require_equal(one, other)
            counts["same"] += 1
    return counts


def test_a_flipped_bit_is_found_or_changes_nothing(tmp_path):
    good = write(tmp_path / "d.h5", some(), stress_location="node")
    counts = flip_and_read(good, tmp_path / "flipped.h5", range(150))
    assert counts["refused"] > 40  # the rest hit bytes that are not used


def test_a_flipped_bit_does_not_crash_the_process(tmp_path):
    good = write(tmp_path / "d.h5", some(), stress_location="node")
    command = [sys.executable, "-c", FLIPS, str(TESTS), good, tmp_path / "flipped.h5", "1000", "1250"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "done\n", "")


def test_flipped_bits_in_the_numbers_are_always_found(tmp_path):
    member = trajectory(block(2, 2, 2), 3)
    path = write(tmp_path / "d.h5", {"train": [member]})
    data = path.read_bytes()
    for frame in member.position:
        start = data.index(frame.tobytes())
        for byte in range(start, start + frame.nbytes, 37):
            path.write_bytes(data[:byte] + bytes([data[byte] ^ 1]) + data[byte + 1 :])
            with pytest.raises(DatasetError, match="train/000000/position cannot be read; the file is damaged"):
                read_all(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no such file"),
        (b"", "cannot be read; the file is damaged or no dataset of ast_sim"),
        (b"PK\x03\x04" * 100, "cannot be read; the file is damaged or no dataset of ast_sim"),
        (b"\x89HDF\r\n\x1a\n" + bytes(1000), "cannot be read; the file is damaged or no dataset of ast_sim"),
    ],
)
def test_what_is_no_dataset_is_named(tmp_path, content, message):
    path = tmp_path / "d.h5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=f"{path}: .*{message}"):
        Dataset(path)


def overwrite(group, name, value, **options):
    del group[name]
    group.create_dataset(name, data=value, **options)


def change(name, function):
    return lambda file: overwrite(file["train/000000"], name, function(file[f"train/000000/{name}"][()]))


def put(array, index, value):
    array[index] = value
    return array


def declare(file, name, shape, dtype):
    """An array that declares a huge shape and stores nothing."""
    del file["train/000000"][name]
    file["train/000000"].create_dataset(name, shape=shape, dtype=dtype, chunks=tuple(min(s, 64) for s in shape))


HOSTILE = {
    "another format": (lambda f: f.attrs.__setitem__("format", "other"), "no dataset of ast_sim"),
    "no format": (lambda f: f.attrs.__delitem__("format"), "no dataset of ast_sim"),
    "a later version": (lambda f: f.attrs.__setitem__("version", 4), "has the version 4 of the format"),
    "no family": (lambda f: f.attrs.__delitem__("family"), "attribute family is missing; must be a str"),
    "a number as text": (
        lambda f: f.attrs.__setitem__("time_step", "x"),
        "attribute time_step is 'x'; must be a float",
    ),
    "two centres": (
        lambda f: f.attrs.__setitem__("domain_center", [0.0, 1.0]),
        "domain_center must be three finite numbers",
    ),
    "a generator that is no JSON": (lambda f: f.attrs.__setitem__("generator", "{"), "generator cannot be read"),
    "a generator that is a list": (lambda f: f.attrs.__setitem__("generator", "[]"), "generator must be a JSON object"),
    "an integration unknown": (lambda f: f.attrs.__setitem__("integration", "x"), "integration is 'x'; must be one of"),
    "a complex attribute": (lambda f: f["train/000000"].attrs.__setitem__("a", 1j), "an attribute of .*train/000000"),
    "a matrix attribute": (lambda f: f["train/000000"].attrs.__setitem__("a", np.eye(2)), "larger than .* or no list"),
    "a sample with a name": (lambda f: f["train"].create_group("best"), "train holds 'best' where 000002 is expected"),
    "a sample left out": (lambda f: f.__delitem__("train/000000"), "train holds '000001' where 000000 is expected"),
    "a split that is an array": (
        lambda f: (f.__delitem__("test"), f.create_dataset("test", data=[1])),
        "test is no group",
    ),
    "no positions": (lambda f: f.__delitem__("train/000000/position"), "train/000000/position is missing"),
    "no stress": (lambda f: f.__delitem__("train/000000/stress"), "train/000000/stress is missing"),
    "positions in double": (change("position", np.float64), "position is float64 with 3 axes; must be float32 with 3"),
    "positions of another mesh": (change("position", lambda a: a[:, 1:]), r"position has the shape \[4, 11, 3\]"),
    "no frames": (change("position", lambda a: a[:0]), "position has no frames"),
    "flat positions": (change("position", lambda a: a[0]), "position is float32 with 2 axes"),
    "a frame of stress less": (change("stress", lambda a: a[1:]), r"stress has the shape \[3, 12, 1\], must be \[4,"),
    "a position that is not finite": (
        change("position", lambda a: put(a, (2, 5, 1), np.nan)),
        "train/000000: position in frame 2 at node 5 is not finite",
    ),
    "a stress that is not finite": (
        change("stress", lambda a: put(a, (3, 0, 0), np.inf)),
        "train/000000: stress in frame 3 at node 0 is not finite",
    ),
    "an element out of range": (
        change("elements", lambda a: put(a, (1, 2), 12)),
        "element 1 refers to node 12, but the nodes are 0 to 11",
    ),
    "an element below zero": (change("elements", lambda a: put(a, (0, 0), -1)), "element 0 refers to node -1"),
    "an unknown node type": (change("node_type", lambda a: put(a, 3, 9)), "node 3 has the type 9"),
    "a material less": (lambda f: f.__delitem__("train/000001/material"), "material columns"),
    "absurd frames": (lambda f: declare(f, "position", (1 << 40, 12, 3), "f4"), "declares the shape"),
    "absurd nodes": (lambda f: declare(f, "rest_position", (1 << 60, 3), "f4"), "declares the shape"),
    "absurd elements": (lambda f: declare(f, "elements", (1 << 33, 4), "i4"), "declares the shape"),
    "compressed": (
        lambda f: overwrite(f["train/000000"], "position", np.zeros((9999, 12, 3), "f4"), compression="gzip"),
        "position is compressed",
    ),
    "a link to another file": (
        lambda f: (f.__delitem__("train/000001"), f.__setitem__("train/000001", h5py.ExternalLink("/x.h5", "/"))),
        "train/000001 is a link to somewhere else",
    ),
    "a link to itself": (
        lambda f: (f.__delitem__("train/000001"), f.__setitem__("train/000001", h5py.SoftLink("/train/000001"))),
        "train/000001",
    ),
    "numbers in another file": (
        lambda f: (
            f.__delitem__("train/000000/body"),
            f["train/000000"].create_dataset("body", (12,), "i4", external=[("/etc/passwd", 0, 48)]),
        ),
        "body keeps its numbers in another file",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_refused_by_name(tmp_path, case):
    edit, message = HOSTILE[case]
    path = write(tmp_path / "d.h5", some(), stress_location="node")
    with h5py.File(path, "r+") as file:
        edit(file)
        sign(file)
    with pytest.raises(DatasetError, match=f"{path}: .*{message}") as error:
        read_all(path)
    assert "\n" not in str(error.value)


def test_the_memory_of_a_hostile_file_is_bounded(tmp_path):
    """Arrays that are declared large, and one array under a thousand names, are not read into memory."""
    path = write(tmp_path / "d.h5", {"train": [trajectory(block(9, 9, 9), 40)]})
    with h5py.File(path, "r+") as file:
        for index in range(1, 1000):
            file[f"train/{index:06d}"] = file["train/000000"]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with Dataset(path) as dataset:
        for index in range(0, 1000, 10):
            assert dataset.frames("train", index, 0, 40)[0].shape == (40, 1000, 3)
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    assert grown < 20 << 20  # 100 copies would take 48 MB


def test_samples_and_frames_that_do_not_exist(tmp_path):
    with Dataset(write(tmp_path / "d.h5", some(), stress_location="node")) as dataset:
        for call, message in [
            (lambda: dataset.scene("train", 2), "no sample 2 in train, which has 2"),
            (lambda: dataset.load("valid", 0), "no sample 0 in valid, which has 0"),
            (lambda: dataset.load("train", -1), "no sample -1"),
            (lambda: dataset.count("validation"), "no split 'validation'; use one of train, valid, test"),
            (lambda: dataset.frames("train", 0, 3, 5), "frames 3 to 5 of 4 do not exist"),
        ]:
            with pytest.raises(DatasetError, match=message):
                call()


def test_an_empty_dataset_says_so(tmp_path):
    with (
        Dataset(write(tmp_path / "d.h5", {})) as dataset,
        pytest.raises(DatasetError, match="holds no samples"),
    ):
        _ = dataset.material_width


def test_reading_and_writing_need_no_torch(tmp_path):
    program = "import ast_sim.dataset.reader, ast_sim.scene, sys; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def test_a_closed_dataset_says_that_it_is_closed(tmp_path):
    path = write(tmp_path / "d.h5", {"train": [trajectory(two_tetrahedra(), 3)] * 2})
    with Dataset(path) as dataset:
        split = dataset["train"]
    for read in (
        lambda: split[0],
        lambda: dataset.load("train", 1),
        lambda: dataset.frames("train", 0, 0, 2),
        lambda: dataset.fingerprint(),
    ):
        with pytest.raises(DatasetError, match=r"d.h5 is closed: open it again with Dataset\(path\)"):
            read()


def test_another_process_opens_a_dataset_from_any_folder(tmp_path, monkeypatch):
    write(tmp_path / "d.h5", some(), stress_location="node")
    monkeypatch.chdir(tmp_path)
    with Dataset("d.h5", "mm") as dataset:
        sent = pickle.dumps(dataset["train"])
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir("elsewhere")
    received = pickle.loads(sent)[0]
    assert received.length_unit == "mm"
    assert np.allclose(received.position, 1000 * some()["train"][0].position, rtol=1e-6)


@pytest.mark.parametrize("second_order", [False, True])
def test_tetrahedra_that_are_inside_out_are_turned_over(tmp_path, second_order):
    """So a dataset has the same bytes however its writer numbered them."""
    scene = raised(block(2, 1, 1)) if second_order else block(2, 1, 1)
    order = [0, 1, 3, 2, 4, 8, 7, 6, 5, 9][: scene.elements.shape[1]]
    numbered = scene.elements.copy()
    numbered[::2] = numbered[::2][:, order]
    position = np.stack([scene.rest_position, scene.rest_position * np.float32(1.1)])
    straight = write(tmp_path / "straight.h5", {"test": [Trajectory(scene, position)]})
    with pytest.warns(UserWarning, match=r"6 tetrahedra that were inside out are turned over, in 1 sim"):
        flipped = write(tmp_path / "flipped.h5", {"test": [Trajectory(replace(scene, elements=numbered), position)]})
    assert flipped.read_bytes() == straight.read_bytes()
