"""Writing a dataset file, whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Self

import h5py
import numpy as np

from ast_sim.dataset.layout import (
    ARRAYS,
    FIELDS,
    FRAMED,
    HASH,
    SPLITS,
    DatasetInfo,
    array_hash,
    field_key,
    plain_value,
    require_kind,
    trajectory_hash,
    write_attributes,
)
from ast_sim.element_topology import turned_over
from ast_sim.material import hints
from ast_sim.named_field import require_same_fields
from ast_sim.scene import Scene, Trajectory
from ast_sim.support.argument_checks import file_name, require_type
from ast_sim.support.disk import Disk, output_file, sync_folder, temporary_name
from ast_sim.support.errors import DatasetError, counted, warn

# On each side the domain is larger than the positions by this share of their largest extent.
MARGIN = 0.1


class DatasetWriter:
    """Writes a dataset. The complete file appears under its name when the `with` block ends without an error.

    Until then a file with a temporary name in the same folder grows; on an error it is removed. `info` is written last,
    so it may be replaced within the block, for example when the positions of all trajectories have given the domain.
    If `path` is a link, the file to which it leads is written.

    Raises:
        AstSimError: `path` is a folder, a device, a pipe or a socket.
        DatasetError: a trajectory does not pass its checks, the disk is full, or the folder cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], info: DatasetInfo) -> None:
        self.path = file_name(path, "path")
        require_type("info", info, DatasetInfo, "a DatasetInfo")
        info.check(str(path))
        self.info = info
        self._is_open = False
        self.counts = dict.fromkeys(SPLITS, 0)
        self._kind: tuple[int, int] | None = None  # (nodes per element, material width) of all trajectories
        self._fields: dict[str, tuple[str, str, int]] | None = None  # the named fields of all trajectories
        self._turned: dict[str, int] = {}  # trajectories, and how many of their tetrahedra were turned over
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file_path = output_file(self.path)
            self._temporary = temporary_name(self._file_path)
            self._disk = Disk(self._temporary)
        except OSError as error:
            raise DatasetError(f"{self.path}: cannot be written: {error}") from error
        # Version 1.10 of HDF5's file format has checksums on all of its structures.
        self._file = h5py.File(self._disk, "w", libver=("v110", "v110"))

    def add(self, split: str, trajectory: Trajectory) -> None:
        """Check a trajectory and append it to the split "train", "valid", "test" or "calibration".

        Tetrahedra that are inside out are turned over, so that a file has the same bytes however its elements were
        numbered; at its end a warning counts them.
        """
        if not self._is_open:
            raise DatasetError(
                f"{self.path}: add in the block of `with DatasetWriter(...)`, at whose end it is written"
            )
        if split not in SPLITS:
            raise DatasetError(f"{self.path}: there is no split {split!r}; use one of {', '.join(SPLITS)}")
        require_type("trajectory", trajectory, Trajectory, "a Trajectory")
        require_type("the attributes", trajectory.attributes, Mapping, "values by name")
        name = f"{split}/{self.counts[split]:06d}"
        trajectory.check(f"{self.path}: {name}", self.info.stress_location)
        trajectory = self._right_side_out(name, trajectory)
        first = self._kind is None
        self._kind = require_kind(f"{self.path}: {name}", trajectory.scene, self._kind)
        self._require_material(f"{self.path}: {name}", trajectory.scene, first)
        self._fields = require_same_fields(f"{self.path}: {name}", trajectory.fields, self._fields)
        if trajectory.length_unit not in (None, self.info.length_unit):
            raise DatasetError(
                f"{self.path}: {name} has lengths in {trajectory.length_unit}, the dataset in {self.info.length_unit}"
            )
        with self._writing():
            group = self._file.create_group(name)
            hashes: dict[str, str] = {}
            for key in ARRAYS:
                array = getattr(trajectory if key in FRAMED else trajectory.scene, key)
                if array is not None:
                    chunks = (1, *array.shape[1:]) if key in FRAMED else array.shape
                    hashes[key] = self._store(group, key, array, chunks)
            hashes |= self._store_fields(group, trajectory)
            write_attributes(group, {"status": "complete", **trajectory.attributes, **self._numbering(trajectory)})
            attributes = {key: plain_value(value) for key, value in group.attrs.items()}
            write_attributes(group, {HASH: trajectory_hash(hashes, attributes)})
        self.counts[split] += 1

    def _right_side_out(self, name: str, trajectory: Trajectory) -> Trajectory:
        scene = trajectory.scene
        if scene.elements.shape[1] == 3 or not (wrong := scene.rest_volumes < 0).any():
            return trajectory
        self._turned[name] = int(wrong.sum())
        return replace(trajectory, scene=replace(scene, elements=turned_over(scene.elements, wrong)))

    def _require_material(self, name: str, scene: Scene, first: bool) -> None:
        """Raise DatasetError unless the material has a name for each column and numbers that a material can have; the
        `first` time, hint at names that look like others."""
        width = 0 if scene.material is None else scene.material.shape[1]
        try:
            material = self.info.material(width)
        except DatasetError as error:
            raise DatasetError(f"{name}: {error}") from error
        for hint in hints(material.columns) if first else ():
            warn(f"{self.path}: {hint}")
        material.require_possible(name, scene.material, ~scene.rigid_elements)

    def _store(self, group: h5py.Group, key: str, array: np.ndarray, chunks: tuple[int, ...], **facts: str) -> str:
        """Store an array with its hash and other facts; return the hash."""
        stored = group.create_dataset(key, data=array, chunks=chunks, fletcher32=True)
        value = array_hash(array.dtype, array.shape, [array])
        write_attributes(stored, {HASH: value, **facts})
        return value

    def _store_fields(self, group: h5py.Group, trajectory: Trajectory) -> dict[str, str]:
        """Store the named fields of a trajectory; return their hashes by `field_key`."""
        hashes = {}
        for name, one in sorted(trajectory.fields.items()):
            chunks = (1, *one.values.shape[1:])
            facts = {"unit": one.unit, "location": one.location}
            hashes[field_key(name, one.unit, one.location)] = self._store(
                group.require_group(FIELDS), name, one.values, chunks, **facts
            )
        return hashes

    def _numbering(self, trajectory: Trajectory) -> dict[str, tuple]:
        """The numbers and the times of the frames, if a reader could not tell them without."""
        usual = {"frames": tuple(range(trajectory.num_frames)), "times": self.info.times(trajectory.numbers)}
        given = {key: getattr(trajectory, key) for key in usual}
        return {key: value for key, value in given.items() if value is not None and value != usual[key]}

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Within the block, raise the first error of the disk as a DatasetError, even if HDF5 hides or changes it."""
        failure = None
        try:
            yield
        except OSError as error:
            failure = error
        except (RuntimeError, ValueError):
            if self._disk.error is None:
                raise
        failure = self._disk.error or failure
        if failure is not None:
            raise DatasetError(f"{self.path}: cannot be written: {failure}") from failure

    def __enter__(self) -> Self:
        self._is_open = True
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            self._is_open = False
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
        with self._writing():
            os.replace(self._temporary, self._file_path)
            sync_folder(self._file_path.parent)
        if self._turned:
            are = counted(
                sum(self._turned.values()), "tetrahedron that was inside out is", "tetrahedra that were inside out are"
            )
            within = counted(len(self._turned), "simulation", "simulations")
            warn(f"{self.path}: {are} turned over, in {within}, the first is {next(iter(self._turned))}")


class FittedWriter(DatasetWriter):
    """A `DatasetWriter` that fits the domain of its `info` to the positions of all trajectories.

    Args:
        facts: the fields of `DatasetInfo` without the domain.
    """

    def __init__(self, path: str | os.PathLike[str], **facts: Any) -> None:
        super().__init__(path, DatasetInfo(domain_center=(0.0, 0.0, 0.0), domain_half_width=1.0, **facts))
        self._lowest = np.full(3, np.inf)
        self._highest = np.full(3, -np.inf)

    def add(self, split: str, trajectory: Trajectory) -> None:
        super().add(split, trajectory)
        # The minimum over the frames comes first: its rows of 3 N numbers suit vector instructions.
        frames = trajectory.position.reshape(trajectory.num_frames, -1)
        self._lowest = np.minimum(self._lowest, frames.min(axis=0).reshape(-1, 3).min(axis=0))
        self._highest = np.maximum(self._highest, frames.max(axis=0).reshape(-1, 3).max(axis=0))

    def _finish(self) -> None:
        x, y, z = ((self._lowest + self._highest) / 2).tolist()
        half_width = float((0.5 + MARGIN) * (self._highest - self._lowest).max())
        self.info = replace(self.info, domain_center=(x, y, z), domain_half_width=half_width)
        super()._finish()
