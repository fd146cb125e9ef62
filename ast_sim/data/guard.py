"""Reading HDF5 files that are not trusted: nothing is allocated, followed or run before it was checked."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ast_sim.data.layout import ARRAYS, plain_value
from ast_sim.data.scene import AttributeValue
from ast_sim.errors import AstSimError, DatasetError

# What h5py raises on a damaged file.
_READ_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError, MemoryError)


class GuardedFile:
    """An HDF5 file that is open for reading; whatever is wrong in it is a DatasetError that names the file."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with self.reading("the file"):
            if not self.path.is_file():
                raise DatasetError(f"{self.path}: there is no such file")
            self.size = self.path.stat().st_size
            # Chunks are read once each: a cache of them would cost 1 MiB for every array that is open.
            self.root = h5py.File(self.path, "r", locking=False, rdcc_nbytes=0)

    def close(self) -> None:
        self.root.close()

    @contextlib.contextmanager
    def reading(self, what: str) -> Iterator[None]:
        """Turn whatever h5py raises on a damaged file into a DatasetError."""
        try:
            yield
        except AstSimError:
            raise
        except _READ_ERRORS as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise DatasetError(
                f"{self.path}: {what} cannot be read; the file is damaged or no dataset of ast_sim ({text})"
            ) from error

    def attributes(self, group: h5py.Group, name: str) -> dict[str, AttributeValue]:
        """The attributes of a group; `name` is for messages."""
        values = {}
        with self.reading(f"an attribute of {name}"):
            for key in group.attrs:
                stored = group.attrs.get_id(key)
                if math.prod(stored.shape) * stored.dtype.itemsize > self.size or len(stored.shape) > 1:
                    raise DatasetError(f"{name}: the attribute {key} is larger than the file or no list")
                values[key] = plain_value(group.attrs[key])
        return values

    def child(self, group: h5py.Group, key: str, kind: type) -> Any:
        """A member that lies in this very file: no link to elsewhere."""
        name = f"{self.path}: {group.name.strip('/')}/{key}".replace(" /", " ")
        if key not in group:
            raise DatasetError(f"{name} is missing")
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            raise DatasetError(f"{name} is a link to somewhere else, which is not followed")
        child = group[key]
        if not isinstance(child, kind):
            raise DatasetError(f"{name} is no {kind.__name__.lower()}")
        return child

    def array(self, group: h5py.Group, key: str) -> h5py.Dataset:
        """An array of a sample, its dtype, rank and size checked before anything is allocated."""
        dtype, rank = ARRAYS[key]
        array = self.child(group, key, h5py.Dataset)
        name = f"{self.path}: {group.name.strip('/')}/{key}"
        if array.dtype != dtype or array.ndim != rank:
            raise DatasetError(f"{name} is {array.dtype} with {array.ndim} axes; must be {np.dtype(dtype)} with {rank}")
        if array.is_virtual or array.external:
            raise DatasetError(f"{name} keeps its numbers in another file, which is not followed")
        properties = array.id.get_create_plist()
        filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
        if any(code != h5py.h5z.FILTER_FLETCHER32 for code in filters):
            raise DatasetError(f"{name} is compressed; write the file without compression (h5repack -f FLET)")
        item = array.dtype.itemsize
        for shape in (array.shape, array.chunks or ()):
            if math.prod(shape) * item > self.size:
                raise DatasetError(
                    f"{name} declares the shape {list(shape)}, {math.prod(shape) * item} bytes,"
                    f" but the file has {self.size}: it is truncated or damaged"
                )
        return array
