"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from ast_sim.errors import AstSimError


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary name in the folder of `path`, which takes its place at the end and is removed on an error."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn an OSError (no such folder, full disk) into an AstSimError that names `path`."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise AstSimError(
            f"{path} cannot be written ({reason}); nothing half-written was left: make room or choose another place"
        ) from error
