"""Reading a dataset file; its content is checked, never trusted.

Layout: the root has the attributes of `DatasetInfo`, `format` and `version`, and a group for each split, with one group
for each trajectory (`000000`, `000001`, ...), which has the arrays of `Scene` and `Trajectory`. Each frame is a chunk.
Flipped bits are found: every array has the Fletcher-32 filter, and HDF5's own structures have checksums.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterator
from numbers import Integral
from typing import TYPE_CHECKING, Self

import h5py
import numpy as np

from ast_sim.dataset.guard import GuardedFile
from ast_sim.dataset.layout import (
    ARRAYS,
    FIELD_KIND,
    FIELDS,
    FRAMED,
    HASH,
    LENGTH_UNITS,
    NUMBERING,
    OPTIONAL,
    SPLITS,
    numbering,
    require_kind,
)
from ast_sim.dataset.split import Split, first_scene
from ast_sim.material import Material
from ast_sim.named_field import NamedField
from ast_sim.number_arrays import require_finite, require_numbering
from ast_sim.scene import AttributeValue, Scene, Trajectory
from ast_sim.support.argument_checks import file_name, require_type, several
from ast_sim.support.byte_cache import ByteCache, cache_bytes
from ast_sim.support.errors import DatasetError
from ast_sim.support.notebook_table import html_table, one_line
from ast_sim.support.read_only_arrays import kept

if TYPE_CHECKING:
    from ast_sim import FramePairs


class Dataset:
    """Reads a dataset file; a context manager.

    Each trajectory is checked when it is first read: dtypes, shapes, index ranges. All numbers are finite, and arrays
    are read-only. A split of at most an eighth of the machine's memory, and at most 4 GiB, stays in memory after
    its first reading.

    Args:
        path: the file.
        length_unit: the unit in which positions, origins and what `info` says of lengths are given; by default the one
            of the file. The solver's records stay as they are.

    Raises:
        DatasetError: something cannot be read; the text names the file, the sample and what is wrong.
    """

    def __init__(self, path: str | os.PathLike[str], length_unit: str | None = None) -> None:
        self.path = file_name(path, "path")
        self.absolute_path = self.path.absolute()  # whatever folder this process works in later
        self._file = GuardedFile(self.path)
        try:
            stored = self._file.info()
            self.info = stored if length_unit is None else stored.in_unit(length_unit, str(self.path))
            self._scale = LENGTH_UNITS[stored.length_unit] / LENGTH_UNITS[self.info.length_unit]
            with self._file.reading("the list of samples"):
                self.splits = {split: self._count(split) for split in SPLITS}
        except BaseException:
            self.close()
            raise
        self._scenes: ByteCache[Scene] = ByteCache(cache_bytes())
        self._frames: dict[tuple[str, int], tuple[np.ndarray, np.ndarray | None]] = {}
        self._open: dict[tuple[str, int], dict[str, h5py.Dataset]] = {}
        self._kept: dict[str, bool] = {}  # whether the split is small enough to be kept in memory
        self._kind: tuple[int, int] | None = None

    def _facts(self) -> dict[str, str]:
        counts = ", ".join(f"{count:,} {split}" for split, count in self.splits.items() if count)
        return {
            "file": self.path.name,
            "scenes": counts or "none",
            "family": self.info.family,
            "stress": {"none": "none"}.get(self.info.stress_location, f"at each {self.info.stress_location}"),
            "lengths": self.info.length_unit,
        }

    def __repr__(self) -> str:
        return one_line("Dataset", self._facts())

    def _repr_html_(self) -> str:
        return html_table("Dataset", self._facts(), first_scene(self[split] for split in self.splits))

    def __getitem__(self, split: str) -> Split:
        """The trajectories of a split: `dataset["test"][0]`."""
        return Split(self, split, range(self.count(split)))

    def __iter__(self) -> Iterator[str]:
        """The names of the splits."""
        return iter(self.splits)

    def __len__(self) -> int:
        """The number of splits."""
        return len(self.splits)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce__(self) -> tuple[type[Self], tuple[str, str]]:
        """Another process, such as one of a DataLoader, opens the file for itself, in whatever folder it works."""
        return type(self), (str(self.absolute_path), self.info.length_unit)

    def close(self) -> None:
        self._file.close()

    def torch(self, split: str) -> FramePairs:
        """The pairs of frames of a split as tensors by name, for a DataLoader of torch and a network of your own."""
        from ast_sim import FramePairs  # by its public name: this room is used without torch

        return FramePairs(self, split)

    @property
    def calibration(self) -> Split:
        """Scenes for measuring the errors of a trained model beforehand: they take no part in its training, in the
        choice of its checkpoint and in its test."""
        return self["calibration"]

    @property
    def material_width(self) -> int:
        """The number of material columns that every scene has."""
        return self._first_kind()[1]

    @property
    def material(self) -> Material:
        """The names of the material columns that every scene has; a DatasetError: the file names too many or few."""
        try:
            return self.info.material(self.material_width)
        except DatasetError as error:
            raise DatasetError(f"{self.path}: {error}") from error

    @property
    def element_size(self) -> int:
        """The number of nodes per element in every scene: 3, 4 or 10."""
        return self._first_kind()[0]

    def count(self, split: str) -> int:
        """The number of trajectories in a split."""
        if split not in SPLITS:
            raise DatasetError(f"{self.path}: there is no split {split!r}; use one of {', '.join(SPLITS)}")
        return self.splits[split]

    def scene(self, split: str, index: int) -> Scene:
        """The scene of a trajectory, checked. The last used scenes stay in memory."""
        return self._scenes.get((split, index), lambda: self._read_scene(split, index))

    def _read_scene(self, split: str, index: int) -> Scene:
        group, name = self._group(split, index), self._name(split, index)
        keys = [key for key in ARRAYS if key not in FRAMED and (key not in OPTIONAL or self._file.has(group, key))]
        arrays = {key: self._file.read(self._file.array(group, key)) for key in keys}
        scene = Scene(**{**arrays, "rest_position": self._scaled(arrays["rest_position"])})
        scene.check(name)
        self._kind = require_kind(name, scene, self._kind)
        return scene

    def num_frames(self, split: str, index: int) -> int:
        """The number of frames of a trajectory."""
        return len(self._framed(split, index)["position"])

    def numbers(self, split: str, index: int) -> tuple[int, ...]:
        """The numbers of the frames of a trajectory in its motion. As of `num_frames`, hashes are compared later."""
        stored = self._file.attribute(self._unverified(split, index), NUMBERING[0])
        with self._file.reading(f"the attribute frames of {split}/{index:06d}"):
            return tuple(map(int, stored if isinstance(stored, list) else range(self.num_frames(split, index))))

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

    def load(self, split: str, index: int, fields: Collection[str] = ()) -> Trajectory:
        """A trajectory without its `cauchy_stress`, and with these `fields`, if it has them: all are large;
        `dataset[split][index]` has all."""
        position, stress = self.frames(split, index, 0, self.num_frames(split, index))
        frames, times = self._numbering(split, index)
        trajectory = Trajectory(
            self.scene(split, index),
            position,
            stress,
            self.attributes(split, index),
            stress_location=self.info.stress_location,
            frames=frames,
            times=times,
            length_unit=self.info.length_unit,
            fields=self.fields(split, index, fields) if fields else {},
        )
        require_numbering(self._name(split, index), trajectory.num_frames, frames, times)
        return trajectory

    def _numbering(self, split: str, index: int) -> tuple[tuple[int, ...] | None, tuple[float, ...] | None]:
        """The numbers and the times of the frames of a trajectory. Without times of its own, they follow from the time
        step of the dataset."""
        numbers, times = numbering(self._file.attributes(self._group(split, index)))
        if times is None:
            times = self.info.times(range(self.num_frames(split, index)) if numbers is None else numbers)
        return numbers, times

    def fingerprint(self) -> str:
        """The SHA-256 of what the dataset says of itself and of the hashes of all its trajectories."""
        digest = hashlib.sha256(repr((self.info, self.splits)).encode())
        for split, count in self.splits.items():
            for index in range(count):
                digest.update(self._file.stored_hash(self._unverified(split, index)).encode())
        return digest.hexdigest()

    def with_frames(self, split: str, least: int) -> list[int]:
        """The trajectories of a split with at least `least` frames. Where a solver gave up at once, one is left."""
        return [index for index in range(self.count(split)) if self.num_frames(split, index) >= least]

    def spread(self, split: str, most: int, fields: Collection[str] = ()) -> Iterator[tuple[str, Trajectory]]:
        """At most `most` trajectories of a split that move, as `load` reads them, evenly spread, with their names."""
        moving = self.with_frames(split, 2)
        for place in np.unique(np.linspace(0, len(moving) - 1, min(len(moving), most)).astype(int)):
            yield self._name(split, moving[place]), self.load(split, moving[place], fields)

    def cauchy_stress(self, split: str, index: int, start: int = 0, stop: int | None = None) -> np.ndarray | None:
        """Cauchy stress [stop - start, E, 6] of frames start to stop - 1; None if the trajectory has none."""
        group, count = self._group(split, index), self.num_frames(split, index)
        stop = count if stop is None else stop
        self._require_frames(split, index, start, stop)
        if not self._file.has(group, "cauchy_stress"):
            return None
        shape = (count, self.scene(split, index).num_elements, 6)
        array = self._file.array(group, "cauchy_stress", shape)
        return self._finite(self._name(split, index), "element", array, start, stop)

    def fields(self, split: str, index: int, names: Collection[str] | None = None) -> dict[str, NamedField]:
        """The named fields of a trajectory, in all frames; with `names`, only these, where it has them."""
        wanted = None if names is None else set(several("fields", names, "names"))
        group, count = self._group(split, index), self.num_frames(split, index)
        if not self._file.has(group, FIELDS):
            return {}
        scene, name = self.scene(split, index), self._name(split, index)
        stored = self._file.child(group, FIELDS, h5py.Group)
        fields: dict[str, NamedField] = {}
        for key in sorted(stored if wanted is None else wanted.intersection(stored)):
            array = self._file.array(stored, key, kind=FIELD_KIND)
            facts = self._file.attributes(array)
            fields[key] = NamedField(self._file.read(array), str(facts.get("location")), str(facts.get("unit", "")))
            fields[key].check(name, key, count, scene.num_nodes, scene.num_elements)
        return fields

    def attributes(self, split: str, index: int) -> dict[str, AttributeValue]:
        """The status and the solver's records of a trajectory."""
        values = self._file.attributes(self._group(split, index))
        if "origin" in values:
            values["origin"] = (self._scale * np.asarray(values["origin"])).tolist()
        return {key: value for key, value in values.items() if key != HASH and key not in NUMBERING}

    def _first_kind(self) -> tuple[int, int]:
        split = next((split for split in SPLITS if self.splits[split]), None)
        if split is None:
            raise DatasetError(f"{self.path}: holds no samples")
        return require_kind(self._name(split, 0), self.scene(split, 0), self._kind)

    def _name(self, split: str, index: int) -> str:
        return f"{self.path}: {split}/{index:06d}"

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
        group = self._unverified(split, index)
        self._file.verify(group)
        return group

    def _unverified(self, split: str, index: int) -> h5py.Group:
        """The group of a trajectory before its hash was compared."""
        require_type("index", index, Integral, "a whole number")
        if not 0 <= index < self.count(split):
            raise DatasetError(f"{self.path}: there is no sample {index} in {split}, which has {self.count(split)}")
        return self._file.child(self._file.child(self._file.root, split, h5py.Group), f"{index:06d}", h5py.Group)

    def _framed(self, split: str, index: int) -> dict[str, h5py.Dataset]:
        """The open arrays of a trajectory that have frames; their shapes fit the mesh. A training asks for the number
        of frames of all trajectories before it begins, so hashes are compared later, where numbers are read."""
        key = (split, index)
        if key not in self._open:
            group = self._unverified(split, index)
            count = len(self._file.array(group, "position"))
            if count == 0:
                raise DatasetError(f"{self._name(split, index)}: position has no frames")
            nodes = len(self._file.array(group, "rest_position"))
            shapes = {"position": (count, nodes, 3)}
            if self.info.stress_location != "none":
                rows = nodes if self.info.stress_location == "node" else len(self._file.array(group, "elements"))
                shapes["stress"] = (count, rows, 1)
            self._open[key] = {name: self._file.array(group, name, shape) for name, shape in shapes.items()}
        return self._open[key]

    def _require_frames(self, split: str, index: int, start: int, stop: int) -> None:
        count = self.num_frames(split, index)
        if not 0 <= start <= stop <= count:
            raise DatasetError(f"{self._name(split, index)}: frames {start} to {stop} of {count} do not exist")

    def _read_frames(self, split: str, index: int, start: int, stop: int) -> tuple[np.ndarray, np.ndarray | None]:
        rows = {"position": "node", "stress": self.info.stress_location}
        self._group(split, index)  # compares its hash
        name, arrays = self._name(split, index), self._framed(split, index)
        frames = {key: self._finite(name, rows[key], array, start, stop) for key, array in arrays.items()}
        return self._scaled(frames["position"]), frames.get("stress")

    def _scaled(self, position: np.ndarray) -> np.ndarray:
        """Positions in the unit of `info`."""
        if self._scale == 1:
            return position
        return kept((self._scale * position.astype(np.float64)).astype(np.float32))

    def _finite(self, name: str, row: str, array: h5py.Dataset, start: int, stop: int) -> np.ndarray:
        """Frames start to stop - 1 of an array, all finite; a `row` of it is a "node" or an "element"."""
        values = self._file.read(array, start, stop)
        require_finite(name, str(array.name).rpartition("/")[2], row, values, start)
        return values

    def _keeps(self, split: str) -> bool:
        if split not in self._kept:
            samples = (self._framed(split, index) for index in range(self.splits[split]))
            size = sum(array.nbytes for arrays in samples for array in arrays.values())
            self._kept[split] = size <= min(cache_bytes(), self._file.size)
        return self._kept[split]
