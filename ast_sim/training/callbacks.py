"""What a training tells a function of the caller while it runs, and the writer for TensorBoard."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

from ast_sim.support.argument_checks import file_name
from ast_sim.support.errors import require
from ast_sim.support.notebook_table import one_line
from ast_sim.view.files import make_folder

Callback = Callable[[int, dict[str, float]], None]


class Listener:
    """Calls a callback with the numbers of records.

    Attributes:
        error: what the callback has raised; from then on it is not called. The training ends with it,
            after a checkpoint.
    """

    def __init__(self, callback: Callback | None) -> None:
        self.callback = callback
        self.error: BaseException | None = None

    def hear(self, step: int, record: Mapping[str, Any]) -> None:
        """Give the callback the numbers of a record; what is None, a text or a table is left out."""
        if self.callback is None or self.error is not None:
            return
        figures = {key: float(value) for key, value in record.items() if isinstance(value, int | float)}
        try:
            self.callback(step, figures)
        except BaseException as error:
            self.error = error


class TensorBoard:
    """A `callback` of `train` that writes the figures as scalars for TensorBoard: `tensorboard --logdir FOLDER`.

    Args:
        folder: for the event files; it is made if it is absent. A resumed training adds a file to it.

    Raises:
        AstSimError: the folder cannot be made.
        MissingExtra: tensorboard is not installed.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        _, board = require("tensorboard", "tensorboard", "torch.utils.tensorboard")
        self.folder = file_name(folder, "folder")
        make_folder(self.folder)
        self._writer = board.SummaryWriter(str(self.folder))

    def __repr__(self) -> str:
        return one_line("TensorBoard", {"folder": self.folder})

    def __call__(self, step: int, figures: Mapping[str, float]) -> None:
        for name, value in figures.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()
