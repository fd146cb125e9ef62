"""Writing files so that a full disk or a lost power supply leaves either the old file or the new one."""

from __future__ import annotations

import contextlib
import io
import os
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any


def sync_folder(path: str | os.PathLike[str]) -> None:
    """Wait until the names in a folder (a rename in it) are on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_synced(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a new file and wait until its content is on the disk."""
    with open(path, "xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name in the folder of `path`, which takes its place at the end and is removed on an error."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


class Disk(io.RawIOBase):
    """A new file that keeps the first error of a write in `error` instead of raising it.

    HDF5 cannot close a file whose last writes fail: it leaves the file open and tries again when the process ends.
    So it is let believe that they succeeded, and its user raises the error that is kept here.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._file = io.FileIO(path, "x+")
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        self._attempt(lambda: self._write_all(view))
        return len(view)

    def _write_all(self, view: memoryview) -> None:
        while view:
            view = view[self._file.write(view) :]

    def truncate(self, size: int | None = None) -> int:
        self._attempt(lambda: self._file.truncate(size))
        return self._file.tell() if size is None else size

    def sync(self) -> None:
        self._attempt(lambda: os.fsync(self._file.fileno()))

    def close(self) -> None:
        if not self.closed:
            self._attempt(self._file.close)
            super().close()

    def readinto(self, buffer: Any) -> int:
        return self._file.readinto(buffer)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def _attempt(self, action: Callable[[], object]) -> None:
        """Run the action unless an earlier one failed."""
        if self.error is None:
            try:
                action()
            except OSError as error:
                self.error = error
