"""Writing files so that a full disk or a lost power supply leaves either the old file or the new one."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import json
import os
import platform
import re
import secrets
import shutil
import stat
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ast_sim.support.errors import AstSimError

_MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"  # machines that share a folder do not share process numbers
_LEFTOVER = re.compile(rf"\..+\.{_MACHINE}-([0-9]+)-[0-9a-f]{{8}}\.tmp")
_LEFTOVER_AGE = 60.0  # seconds without a write


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


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """The text of a file that a user names.

    Raises:
        OSError: it cannot be read, or is no regular file: a pipe without a writer would block for ever.
        ValueError: it has another encoding.
    """
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no regular file", str(path))
    return path.read_text(encoding=encoding)


def output_file(path: Path) -> Path:
    """The regular file that writing to `path` makes or replaces: where a link leads, or else `path` itself.

    Raises:
        AstSimError: `path` is a folder, a device, a pipe or a socket; or no file can be made there: a long work would
            end in vain.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:  # or a link to a file that is not there yet
        mode = stat.S_IFREG
    except OSError as error:
        raise _unwritable(path, error) from error
    if stat.S_ISDIR(mode):
        raise AstSimError(f"{path} is a folder: name a file")
    if not stat.S_ISREG(mode):
        raise AstSimError(f"{path} is a device, a pipe or a socket, which a file would replace: name a regular file")
    real = Path(os.path.realpath(path)) if path.is_symlink() else path
    folders = real.absolute().parents
    if path.is_symlink():  # its folder is not made
        folders = folders[:1]
    try:
        with tempfile.TemporaryFile(dir=next((one for one in folders if one.exists()), folders[0])):
            return real
    except OSError as error:
        raise _unwritable(path, error) from error


def _unwritable(path: Path, error: OSError) -> AstSimError:
    return AstSimError(f"{path} cannot be written ({error.strerror or error}): choose another place")


def temporary_name(path: Path) -> Path:
    """A new name beside `path`, with the machine and the number of this process in it.

    The first time in a folder, the files under such names that killed processes left there are removed.
    """
    _remove_leftovers(path.parent.absolute())
    return path.with_name(f".{path.name}.{_MACHINE}-{os.getpid()}-{secrets.token_hex(4)}.tmp")


@functools.cache  # once, since the folder of a large data set in the making holds many files
def _remove_leftovers(folder: Path) -> None:
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            match = _LEFTOVER.fullmatch(entry.name)
            if match and not _runs(int(match[1])) and time.time() - entry.stat().st_mtime > _LEFTOVER_AGE:
                if entry.is_dir():
                    shutil.rmtree(entry.path)
                else:
                    os.unlink(entry.path)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # of another user
        return True
    return True


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Gives a temporary name in the folder of `path`, or in the folder of the file to which the link `path` leads.

    At the end of the block the file of that name becomes the output; on an error it is removed.

    Raises:
        AstSimError: `path` is no regular file.
    """
    path = output_file(path)
    temporary = temporary_name(path)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all; its folder is made if it is missing.

    Raises:
        AstSimError: the name does not end in .json, so another file may be meant; or the file cannot be written.
    """
    if path.suffix != ".json":
        raise AstSimError(f"{path}: the name of a file of figures must end in .json")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(values, indent=1, allow_nan=False) + "\n")
    except OSError as error:
        raise AstSimError(f"{path} cannot be written: {error.strerror or error}; no part of it was kept") from error


class Disk(io.FileIO):
    """A new file that keeps the first error of a write in `error` instead of raising it.

    HDF5 cannot close a file whose last writes fail: it leaves the file open and tries again when the process ends.
    So this class reports success to HDF5. Whoever opened the file checks `error` and raises it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path, "x+")
        self.error: OSError | None = None

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        self._attempt(lambda: self._write_all(view))
        return len(view)

    def _write_all(self, view: memoryview) -> None:
        while view:
            view = view[super().write(view) :]

    def truncate(self, size: int | None = None) -> int:
        end = self.tell() if size is None else size
        self._attempt(lambda: io.FileIO.truncate(self, end))
        return end

    def sync(self) -> None:
        self._attempt(lambda: os.fsync(self.fileno()))

    def close(self) -> None:
        try:
            super().close()
        except OSError as error:
            self.error = self.error or error

    def _attempt(self, action: Callable[[], object]) -> None:
        """Run the action, unless an earlier action failed."""
        if self.error is None:
            try:
                action()
            except OSError as error:
                self.error = error
