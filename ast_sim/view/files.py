"""Make folders, and report an error of writing in one line that says what to do."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from ast_sim.support.errors import AstSimError


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


def make_folder(path: Path) -> None:
    """Make a folder if it is not there.

    Raises:
        AstSimError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AstSimError(f"{path} cannot be made ({error.strerror or error}): choose another place") from error
