"""Reading HDF5 files that are not trusted: sizes, links and filters are checked before anything is read."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.dataset.layout import (
    ARRAYS,
    FIELDS,
    FORMAT,
    HASH,
    READABLE,
    DatasetInfo,
    array_hash,
    field_key,
    plain_value,
    trajectory_hash,
)
from ast_sim.scene import AttributeValue
from ast_sim.support.errors import AstSimError, DatasetError, counted
from ast_sim.support.read_only_arrays import kept

HASHED_AT_ONCE = 1 << 24

# What h5py raises on a damaged file.
_READ_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError, MemoryError)


class GuardedFile:
    """An open HDF5 file. Every error in it is raised as a DatasetError that names the file."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.closed = False
        with self.reading("the file"):
            if self.path.is_dir():
                raise DatasetError(f"{self.path} is a folder: name the file of a dataset")
            if self.path.exists() and not self.path.is_file():
                raise DatasetError(f"{self.path} is no regular file: name the file of a dataset")
            if not self.path.is_file():
                raise DatasetError(f"{self.path}: there is no such file")
            self.size = self.path.stat().st_size
            # Each chunk is read once, so a cache of chunks would waste 1 MiB for every open array.
            self.root = h5py.File(self.path, "r", locking=False, rdcc_nbytes=0)
        self._verified: set[str] = set()  # names of arrays and trajectories whose hashes have been compared

    def close(self) -> None:
        self.closed = True
        self.root.close()

    @contextlib.contextmanager
    def reading(self, what: str) -> Iterator[str]:
        """Within the block, raise every error of h5py as a DatasetError; `what` names what is read. Gives that name,
        with the path of the file before it."""
        name = f"{self.path}: {what}"
        if self.closed:
            raise DatasetError(f"{self.path} is closed: open it again with Dataset(path) before {what} is read")
        try:
            yield name
        except AstSimError:
            raise
        except _READ_ERRORS as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(
                f"{name} cannot be read; the file is damaged or no dataset of ast_sim ({text})"
            ) from error

    def info(self) -> DatasetInfo:
        """What the dataset says of itself."""
        values = self.attributes(self.root)
        if values.get("format") != FORMAT:
            raise DatasetError(f"{self.path}: is no dataset of ast_sim (its attribute format is not {FORMAT!r})")
        if values.get("version") not in READABLE:
            raise DatasetError(
                f"{self.path}: has the version {values.get('version')} of the format; this program reads"
                f" {' and '.join(map(str, READABLE))}"
            )
        types = {"domain_center": list, "domain_half_width": float, "contact_radius": float, "time_step": float}
        known: dict[str, Any] = {}
        for key in (item.name for item in fields(DatasetInfo)):
            wanted = types.get(key, str)
            if not isinstance(values.get(key), wanted):
                shown = repr(values[key])[:60] if key in values else "missing"
                raise DatasetError(f"{self.path}: the attribute {key} is {shown}; must be a {wanted.__name__}")
            known[key] = values[key]
        known["domain_center"] = tuple(known["domain_center"])
        with self.reading("the attribute generator"):
            known["generator"] = json.loads(known["generator"])
            if not isinstance(known["generator"], dict):
                raise DatasetError(f"{self.path}: the attribute generator must be a JSON object")
        info = DatasetInfo(**known)
        info.check(str(self.path))
        return info

    def attributes(self, group: h5py.Group | h5py.Dataset) -> dict[str, AttributeValue]:
        """The attributes of a group or of an array."""
        with self.reading(f"an attribute of {_path(group) or 'the file'}") as name:
            return {key: self._attribute(name, group, key) for key in group.attrs}

    def attribute(self, group: h5py.Group, key: str) -> AttributeValue | None:
        """One attribute of a group, much sooner than all of them; None if it has none of this name."""
        with self.reading(f"an attribute of {_path(group)}") as name:
            return self._attribute(name, group, key) if key in group.attrs else None

    def _attribute(self, name: str, group: h5py.Group | h5py.Dataset, key: str) -> AttributeValue:
        size = h5py.h5a.get_info(group.id, key.encode("utf-8", "surrogateescape")).data_size
        value: Any = group.attrs[key] if size <= self.size else None
        if value is None or np.ndim(value) > 1:
            raise DatasetError(f"{name}, {key}, is larger than the file, or no list")
        return plain_value(value)

    def verify(self, group: h5py.Group) -> None:
        """Compare the hash of a trajectory with the hashes of its arrays and with its attributes, at its first use."""
        if group.name in self._verified:
            return
        attributes = self.attributes(group)
        with self.reading(f"sample {_path(group)}"):
            arrays = {key: str(plain_value(group[key].attrs[HASH])) for key in ARRAYS if key in group}
            if FIELDS in group:
                arrays |= self._hashes_of_fields(self.child(group, FIELDS, h5py.Group))
        self._verify(str(group.name), trajectory_hash(arrays, attributes), attributes.get(HASH))

    def stored_hash(self, group: h5py.Group | h5py.Dataset) -> str:
        """The hash that a trajectory or an array was written with; nothing is compared."""
        with self.reading(f"the hash of {_path(group)}"):
            return str(plain_value(group.attrs[HASH]))

    def _hashes_of_fields(self, fields: h5py.Group) -> dict[str, str]:
        """The hashes of named fields by `field_key`."""
        hashes = {}
        for key in map(str, fields):
            facts = self.attributes(self.child(fields, key, h5py.Dataset))
            hashes[field_key(key, str(facts["unit"]), str(facts["location"]))] = str(facts[HASH])
        return hashes

    def _verify(self, name: str, computed: str, stored: Any) -> None:
        if computed != (stored.decode() if isinstance(stored, bytes) else stored):
            raise DatasetError(
                f"{self.path}: {name.strip('/')} is not what was written: it was edited or is damaged (its SHA-256"
                " differs); write the dataset again with DatasetWriter"
            )
        self._verified.add(name)

    def has(self, group: h5py.Group, key: str) -> bool:
        """Whether a group has a member of this name."""
        with self.reading(_path(group, key)):
            return key in group

    def child(self, group: h5py.Group, key: str, kind: type) -> Any:
        """A member of a group. It must lie in this file; a link to another file is refused."""
        with self.reading(_path(group, key)) as name:
            if key not in group:
                raise DatasetError(f"{name} is missing")
            if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                raise DatasetError(f"{name} is a link to somewhere else, which is not followed")
            child = group[key]
            if not isinstance(child, kind):
                raise DatasetError(f"{name} is no {kind.__name__.lower()}")
            return child

    def array(
        self,
        group: h5py.Group,
        key: str,
        shape: tuple[int, ...] | None = None,
        kind: tuple[type, int] | None = None,
    ) -> h5py.Dataset:
        """An array of a sample. Its dtype and rank (`kind`; else as its name says), its size and, if `shape` is given,
        its shape are checked; nothing is read."""
        dtype, rank = ARRAYS[key] if kind is None else kind
        array = self.child(group, key, h5py.Dataset)
        with self.reading(_path(group, key)) as name:
            if array.dtype != dtype or array.ndim != rank:
                stored = f"{array.dtype} with {counted(array.ndim, 'axis', 'axes')}"
                raise DatasetError(f"{name} is {stored}; must be {np.dtype(dtype)} with {rank}")
            if array.is_virtual or array.external:
                raise DatasetError(f"{name} keeps its numbers in another file, which is not followed")
            properties = array.id.get_create_plist()
            filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
            if any(code != h5py.h5z.FILTER_FLETCHER32 for code in filters):
                raise DatasetError(f"{name} is compressed; write the file without compression (h5repack -f FLET)")
            for declared in (array.shape, array.chunks or ()):
                size = math.prod(declared) * array.dtype.itemsize
                if size > self.size:
                    raise DatasetError(
                        f"{name} declares the shape {list(declared)}, {size} bytes, but the file has"
                        f" {self.size}: it is truncated or damaged"
                    )
            if shape not in (None, array.shape):
                raise DatasetError(f"{name} has the shape {list(array.shape)}, must be {list(shape)}")
            return array

    def read(self, array: h5py.Dataset, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Rows start to stop - 1 of a checked array, by default all rows; they are read-only."""
        name = str(array.name)
        with self.reading(name.strip("/")):
            value = array[start:stop]
            if name not in self._verified:
                whole = [value] if value.shape == array.shape else _rows(array)
                self._verify(name, array_hash(array.dtype, array.shape, whole), array.attrs.get(HASH))
        return kept(value)


def _path(group: h5py.Group | h5py.Dataset, key: str = "") -> str:
    """The path of a group or of its member within the file, without a slash in front."""
    return f"{group.name or ''}/{key}".strip("/")


def _rows(array: h5py.Dataset) -> Iterator[np.ndarray]:
    """The rows of an array, at most HASHED_AT_ONCE bytes of them at a time (at least one row)."""
    rows = max(1, HASHED_AT_ONCE // max(1, math.prod(array.shape[1:]) * array.dtype.itemsize))
    return (array[start : start + rows] for start in range(0, array.shape[0], rows))
