"""The rows of a sweep as a table (CSV), and a quantity over the parameters as a picture."""

from __future__ import annotations

import contextlib
import csv
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.support.argument_checks import file_name
from ast_sim.support.disk import replacing
from ast_sim.support.errors import ConfigError, counted, require
from ast_sim.support.progress import Progress
from ast_sim.view.files import explained, make_folder
from ast_sim.view.picture import INK

Row = Mapping[str, Any]
QUANTITIES = {
    "reaction": ("Reaction", "N"),
    "largest_stress": ("Largest von Mises stress", "Pa"),
    "permanent_set": ("Largest permanent set", ""),  # the picture names the unit of all lengths
}
MOST_CURVES = 12
SECONDS_BETWEEN_PARTS = 10.0


def write_table(path: str | os.PathLike[str], rows: Sequence[Row]) -> None:
    """Write rows as CSV with all keys that any row has, in the order of their first use.

    Raises:
        AstSimError: the file cannot be written.
    """
    path = Path(path)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with explained(path), replacing(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@contextlib.contextmanager
def finished_rows(
    path: str | os.PathLike[str] | None, table: Sequence[Row], rows: int, progress: Progress
) -> Iterator[Callable[[], None]]:
    """Gives a function that writes the finished rows of a sweep, `table`, as CSV now and then. The file is there from
    the beginning; at the end it has all rows. If the block fails or is interrupted, a line says so, and without rows
    the file is removed. Without a path nothing is written.

    Raises:
        AstSimError: the file cannot be written.
    """
    if path is None:
        yield lambda: None
        return
    path = file_name(path, "part")
    make_folder(path.parent)
    write_table(path, [])  # another sweep sees it, and a full disk is told before any work
    due = time.monotonic() + SECONDS_BETWEEN_PARTS

    def keep() -> None:
        nonlocal due
        began = time.monotonic()
        if began >= due:
            write_table(path, table)
            now = time.monotonic()
            due = now + max(SECONDS_BETWEEN_PARTS, 20 * (now - began))  # long tables: a twentieth of the time

    try:
        yield keep
    except BaseException:
        if table:
            write_table(path, table)
            progress.line(f"stopped: the first {len(table):,} of {counted(rows, 'row')} are in {path}")
        else:
            path.unlink(missing_ok=True)
        raise
    write_table(path, table)


def write_picture(
    path: str | os.PathLike[str], rows: Sequence[Row], varied: Sequence[str], quantity: str, length_unit: str
) -> None:
    """Write a PNG of a quantity over the varied parameters.

    One parameter gives a curve, or points if its values are names of files. Two give a curve over the first for each
    value of the second, or points in colours if these are many; more than two give the same for the first two.

    Args:
        rows: the values of the parameters and of the quantity. Rows without the quantity are left out.
        varied: the names of the parameters.
        quantity: its key in the rows.
        length_unit: unit of length, for the title.

    Raises:
        ConfigError: no row has the quantity, or no parameter varies.
        AstSimError: the file cannot be written.
        MissingExtra: matplotlib is not installed.
    """
    shown = [row for row in rows if isinstance(row.get(quantity), int | float)]
    numbers = [name for name in varied if all(isinstance(row[name], int | float) for row in rows)]
    if not shown:
        raise ConfigError(f"no row has {quantity!r}; the rows have: {', '.join(rows[0]) if rows else 'nothing'}")
    if not varied:
        raise ConfigError("no parameter varies, so there is nothing to draw over")
    figures, agg = require("view", "matplotlib.figure", "matplotlib.backends.backend_agg")
    figure = figures.Figure(figsize=(6.4, 4.2), facecolor="white")
    agg.FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    first = (numbers or varied)[0]
    others = [name for name in varied if name != first]
    x = np.array([row[first] for row in shown], float if numbers else str)
    y = np.array([float(row[quantity]) for row in shown])
    if not numbers:  # names of files stand side by side
        names, x = np.unique(x, return_inverse=True)
        axes.set_xticks(range(len(names)), names)
    groups = [row[others[0]] for row in shown] if others else [""] * len(shown)
    if len(set(groups)) <= MOST_CURVES:
        _curves(axes, x, y, groups, others)
    else:
        dots = axes.scatter(x, y, c=np.unique(groups, return_inverse=True)[1], s=12, cmap="viridis")
        figure.colorbar(dots, label=f"{others[0]}, from the lowest to the highest", ticks=[])
    title, unit = QUANTITIES.get(quantity, (quantity, ""))
    axes.set_xlabel(first, color=INK)
    axes.set_ylabel(f"{title} ({unit})" if unit else title, color=INK)
    axes.set_title(f"lengths in {length_unit}", fontsize=8, color=INK, loc="right")
    axes.grid(alpha=0.25)
    figure.tight_layout()
    path = Path(path)
    with explained(path), replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=144)


def _curves(axes, x: np.ndarray, y: np.ndarray, groups: Sequence[Any], others: Sequence[str]) -> None:
    """A curve for each group; points alone where more parameters vary than a curve can show, or names."""
    style = "o-" if len(others) < 2 and x.dtype.kind == "f" else "o"
    for group in dict.fromkeys(groups):
        mine = np.array([other == group for other in groups])
        order = np.argsort(x[mine], kind="stable")
        shown = group if isinstance(group, str) else f"{group:.4g}"
        label = f"{others[0]} = {shown}" if others else None
        axes.plot(x[mine][order], y[mine][order], style, markersize=3, label=label)
    if others:
        axes.legend(fontsize=8, frameon=False)
