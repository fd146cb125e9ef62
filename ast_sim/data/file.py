"""The dataset file: one HDF5 file with its splits, written at once or not at all, and never trusted when read.

Layout: attributes of `DatasetInfo` with `format` and `version` at the root; groups `train`, `valid`, `test` with one
group per trajectory (`000000`, `000001`, ...) that holds the arrays of `Scene` and `Trajectory`. Frames are chunks.
The file format version of HDF5 is one that carries checksums on its own structures, and every array carries the
Fletcher-32 filter, so that flipped bits are found.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import secrets
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Self

import h5py
import numpy as np

from ast_sim.data.disk import Disk, sync_folder
from ast_sim.data.guard import GuardedFile
from ast_sim.data.layout import (
    ARRAYS,
    FORMAT,
    FRAMED,
    OPTIONAL,
    SPLITS,
    VERSION,
    DatasetInfo,
    scene_kind,
    write_attributes,
)
from ast_sim.data.scene import AttributeValue, Scene, Trajectory, require_finite_frames
from ast_sim.errors import DatasetError

CACHE_BYTES = 1 << 30  # splits up to this size are kept in memory after their first reading


class DatasetWriter:
    """Writes a dataset; the file appears under its name, whole, when the `with` block ends without an error.

    Until then it grows under a temporary name in the same folder, which is removed on an error. `info` is written at
    the end and may be replaced before: the domain is often known only when all positions are.

    Raises:
        DatasetError: a trajectory that does not pass its checks, a full disk, a folder that cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], info: DatasetInfo) -> None:
        info.check(str(path))
        self.path = Path(path)
        self.info = info
        self._counts = dict.fromkeys(SPLITS, 0)
        self._kind: tuple[int, int] | None = None  # (nodes per element, material width) of all trajectories
        self._temporary = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}.tmp")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._disk = Disk(self._temporary)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be written: {error}") from error
        # Version 1.10 of the format has checksums on all of its structures.
        self._file = h5py.File(self._disk, "w", libver=("v110", "v110"))

    def add(self, split: str, trajectory: Trajectory) -> None:
        """Append a trajectory to the split "train", "valid" or "test"."""
        if split not in SPLITS:
            raise DatasetError(f"{self.path}: there is no split {split!r}; use one of {', '.join(SPLITS)}")
        name = f"{split}/{self._counts[split]:06d}"
        trajectory.check(f"{self.path}: {name}", self.info.stress_location)
        kind = scene_kind(trajectory.scene)
        if self._kind not in (None, kind):
            raise DatasetError(
                f"{self.path}: {name}: has {kind[0]} nodes per element and {kind[1]} material columns,"
                f" the trajectories before it {self._kind[0]} and {self._kind[1]}"
            )
        self._kind = kind
        with self._writing():
            group = self._file.create_group(name)
            for key in ARRAYS:
                array = getattr(trajectory if key in FRAMED else trajectory.scene, key)
                if array is not None:
                    chunks = (1, *array.shape[1:]) if key in FRAMED else array.shape
                    group.create_dataset(key, data=array, chunks=chunks, fletcher32=True)
            write_attributes(group, {"status": "complete", **trajectory.attributes})
        self._counts[split] += 1

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Raise the first error of the disk, whatever HDF5 made of it."""
        try:
            yield
        except (OSError, RuntimeError, ValueError):
            if self._disk.error is None:
                raise
        if self._disk.error is not None:
            raise DatasetError(f"{self.path}: cannot be written: {self._disk.error}") from self._disk.error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            with contextlib.suppress(Exception):
                self._file.close()
            self._disk.close()
            self._temporary.unlink(missing_ok=True)

    def _finish(self) -> None:
        with self._writing():
            self.info.check(str(self.path))
            write_attributes(self._file, self.info.attributes())
            self._file.close()
            self._disk.sync()
            self._disk.close()
        try:
            os.replace(self._temporary, self.path)
            sync_folder(self.path.parent)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be written: {error}") from error


class Dataset:
    """Reads a dataset file; a context manager.

    Each trajectory is checked when it is first read (dtypes, shapes, index ranges) and every number that is handed
    out is finite. Splits of up to 1 GiB are kept in memory after the first reading. Arrays are read-only.

    Raises:
        DatasetError: naming the file, the sample and what is wrong, for whatever cannot be read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._file = GuardedFile(self.path)
        try:
            self.info = self._read_info()
            with self._file.reading("the list of samples"):
                self.splits = {split: self._count(split) for split in SPLITS}
        except BaseException:
            self.close()
            raise
        self._scenes: dict[tuple[str, int], Scene] = {}
        self._frames: dict[tuple[str, int], tuple[np.ndarray, np.ndarray | None]] = {}
        self._open: dict[tuple[str, int], dict[str, h5py.Dataset]] = {}
        self._lengths: dict[tuple[str, int], int] = {}
        self._kept: dict[str, bool] = {}  # whether the split is small enough to be kept in memory
        self._kind: tuple[int, int] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    @property
    def material_width(self) -> int:
        """The number of material columns that every scene has."""
        return self._first_kind()[1]

    @property
    def element_size(self) -> int:
        """The number of nodes per element in every scene: 3 or 4."""
        return self._first_kind()[0]

    def count(self, split: str) -> int:
        """The number of trajectories in a split."""
        if split not in SPLITS:
            raise DatasetError(f"{self.path}: there is no split {split!r}; use one of {', '.join(SPLITS)}")
        return self.splits[split]

    def scene(self, split: str, index: int) -> Scene:
        """The scene of a trajectory, checked; kept in memory."""
        key = (split, index)
        if key not in self._scenes:
            group = self._group(split, index)
            with self._file.reading(f"sample {split}/{index:06d}"):
                present = [name for name in ARRAYS if name not in FRAMED and (name in group or name not in OPTIONAL)]
            arrays = {name: self._read(group, name) for name in present}
            scene = Scene(**arrays)
            scene.check(self._name(split, index))
            self._kind = self._kind or scene_kind(scene)
            if scene_kind(scene) != self._kind:
                raise DatasetError(
                    f"{self._name(split, index)}: {scene_kind(scene)} nodes per element and material columns,"
                    f" other samples have {self._kind}"
                )
            self._scenes[key] = scene
        return self._scenes[key]

    def num_frames(self, split: str, index: int) -> int:
        """The number of frames of a trajectory."""
        key = (split, index)
        if key not in self._lengths:
            self._lengths[key] = self._shape(split, index, "position")[0]
        return self._lengths[key]

    def frames(self, split: str, index: int, start: int, stop: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Frames start to stop - 1: position [stop - start, N, 3] and stress [stop - start, N or E, 1] or None."""
        self._require_frames(split, index, start, stop)
        if not self._keeps(split):
            return self._read_frames(split, index, start, stop)
        key = (split, index)
        if key not in self._frames:
            self._frames[key] = self._read_frames(split, index, 0, self.num_frames(split, index))
        position, stress = self._frames[key]
        return position[start:stop], None if stress is None else stress[start:stop]

    def load(self, split: str, index: int) -> Trajectory:
        """A whole trajectory, without its `cauchy_stress`, which is large and has a method of its own."""
        position, stress = self.frames(split, index, 0, self.num_frames(split, index))
        return Trajectory(self.scene(split, index), position, stress, self.attributes(split, index))

    def cauchy_stress(self, split: str, index: int, start: int = 0, stop: int | None = None) -> np.ndarray | None:
        """Cauchy stress [stop - start, E, 6] of frames start to stop - 1; None if the trajectory has none."""
        group, name, count = self._group(split, index), self._name(split, index), self.num_frames(split, index)
        stop = count if stop is None else stop
        self._require_frames(split, index, start, stop)
        with self._file.reading(f"{split}/{index:06d}/cauchy_stress"):
            if "cauchy_stress" not in group:
                return None
            array = self._file.array(group, "cauchy_stress")
        self._require_shape(name, array, (count, self.scene(split, index).num_elements, 6))
        with self._file.reading(f"{split}/{index:06d}/cauchy_stress"):
            found = array[start:stop]
        require_finite_frames(name, "cauchy_stress", "element", found, start)
        found.flags.writeable = False
        return found

    def attributes(self, split: str, index: int) -> dict[str, AttributeValue]:
        """The status and the solver's records of a trajectory."""
        return self._file.attributes(self._group(split, index), self._name(split, index))

    def _first_kind(self) -> tuple[int, int]:
        if self._kind is None:
            split = next((split for split in SPLITS if self.splits[split]), None)
            if split is None:
                raise DatasetError(f"{self.path}: holds no samples")
            self.scene(split, 0)
        return self._kind

    def _name(self, split: str, index: int) -> str:
        return f"{self.path}: {split}/{index:06d}"

    def _read_info(self) -> DatasetInfo:
        values = self._file.attributes(self._file.root, str(self.path))
        if values.get("format") != FORMAT:
            raise DatasetError(f"{self.path}: is no dataset of ast_sim (its attribute format is not {FORMAT!r})")
        if values.get("version") != VERSION:
            raise DatasetError(
                f"{self.path}: has the version {values.get('version')} of the format; this program reads {VERSION}"
            )
        types = {"domain_center": list, "domain_half_width": float, "contact_radius": float, "time_step": float}
        for key in (item.name for item in fields(DatasetInfo)):
            wanted = types.get(key, str)
            if not isinstance(values.get(key), wanted):
                found = repr(values[key])[:60] if key in values else "missing"
                raise DatasetError(f"{self.path}: the attribute {key} is {found}; must be a {wanted.__name__}")
        known = {item.name: values[item.name] for item in fields(DatasetInfo)}
        known["domain_center"] = tuple(known["domain_center"])
        with self._file.reading("the attribute generator"):
            known["generator"] = json.loads(known["generator"])
            if not isinstance(known["generator"], dict):
                raise DatasetError(f"{self.path}: the attribute generator must be a JSON object")
        info = DatasetInfo(**known)
        info.check(str(self.path))
        return info

    def _count(self, split: str) -> int:
        if split not in self._file.root:
            return 0
        group = self._file.child(self._file.root, split, h5py.Group)
        count = len(group)
        for index, key in enumerate(sorted(group)):
            if key != f"{index:06d}":
                raise DatasetError(f"{self.path}: {split} holds {key!r} where {index:06d} is expected")
        return count

    def _group(self, split: str, index: int) -> h5py.Group:
        count = self.count(split)
        if not 0 <= index < count:
            raise DatasetError(f"{self.path}: there is no sample {index} in {split}, which has {count}")
        with self._file.reading(f"sample {split}/{index:06d}"):
            return self._file.child(self._file.child(self._file.root, split, h5py.Group), f"{index:06d}", h5py.Group)

    def _read(self, group: h5py.Group, key: str) -> np.ndarray:
        with self._file.reading(f"{group.name.strip('/')}/{key}"):
            value = self._file.array(group, key)[()]
        value.flags.writeable = False
        return value

    def _shape(self, split: str, index: int, key: str) -> tuple[int, ...]:
        group = self._group(split, index)
        with self._file.reading(f"{split}/{index:06d}/{key}"):
            return self._file.array(group, key).shape

    def _framed(self, split: str, index: int) -> dict[str, h5py.Dataset]:
        """The arrays of a trajectory that have frames, open and with the shapes that its scene asks for."""
        key = (split, index)
        if key not in self._open:
            name, group, scene = self._name(split, index), self._group(split, index), self.scene(split, index)
            location, count = self.info.stress_location, self.num_frames(split, index)
            if count == 0:
                raise DatasetError(f"{name}: position has no frames")
            shapes = {"position": (count, scene.num_nodes, 3)}
            if location != "none":
                shapes["stress"] = (count, scene.num_nodes if location == "node" else scene.num_elements, 1)
            with self._file.reading(f"sample {split}/{index:06d}"):
                arrays = {array: self._file.array(group, array) for array in shapes}
            for array, shape in shapes.items():
                self._require_shape(name, arrays[array], shape)
            self._open[key] = arrays
        return self._open[key]

    def _require_shape(self, name: str, array: h5py.Dataset, shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            key = array.name.rpartition("/")[2]
            raise DatasetError(f"{name}: {key} has the shape {list(array.shape)}, must be {list(shape)}")

    def _require_frames(self, split: str, index: int, start: int, stop: int) -> None:
        count = self.num_frames(split, index)
        if not 0 <= start <= stop <= count:
            raise DatasetError(f"{self._name(split, index)}: frames {start} to {stop} of {count} do not exist")

    def _read_frames(self, split: str, index: int, start: int, stop: int) -> tuple[np.ndarray, np.ndarray | None]:
        found: dict[str, np.ndarray] = {}
        for key, array in self._framed(split, index).items():
            with self._file.reading(f"{split}/{index:06d}/{key}"):
                found[key] = array[start:stop]
            row = "element" if key == "stress" and self.info.stress_location == "element" else "node"
            require_finite_frames(self._name(split, index), key, row, found[key], start)
            found[key].flags.writeable = False
        return found["position"], found.get("stress")

    def _keeps(self, split: str) -> bool:
        if split not in self._kept:
            keys = ("position",) if self.info.stress_location == "none" else ("position", "stress")
            sizes = (4 * math.prod(self._shape(split, i, key)) for i in range(self.splits[split]) for key in keys)
            self._kept[split] = sum(sizes) <= min(CACHE_BYTES, self._file.size)
        return self._kept[split]
