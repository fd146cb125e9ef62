"""The page of a trade: the error against the seconds of an answer, and what each error costs."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from ast_sim.support.progress import duration
from ast_sim.trade_figures import COLUMNS, WITHIN, Setting, TradeFigures, front
from ast_sim.view import page
from ast_sim.view.encode import finite_json


def write(path: str | os.PathLike[str], figures: TradeFigures, title: str) -> None:
    """Write the page. Errors as in `page.write`."""
    page.write(path, page_data(figures), title)


def page_data(figures: TradeFigures) -> dict[str, Any]:
    """Everything that the page's scripts show, as JSON."""
    return finite_json(
        {
            "kind": "trade",
            "lead": _lead(figures),
            "tiles": [],
            "sides": [
                {"name": "The run", "points": _points(figures.run)},
                {"name": "The solver", "points": _points(figures.solver)},
            ],
            "mesh": figures.mesh_error,
            "columns": [name.capitalize() for name in COLUMNS],
            "rows": [row.cells for row in figures.rows()],
            "note": _note(figures),
            "settings": [
                [side, one.name, f"{100 * one.kept:.3g} %", f"{1000 * one.middle:.3g} ms", one.command or "–"]
                for side, settings in (("the run", figures.run), ("the solver", figures.solver))
                for one in _answered(settings)
            ],
            "facts": [[key.capitalize(), str(value)] for key, value in figures.origin.items()],
            "footer": page.FOOTER,
        }
    )


def _lead(figures: TradeFigures) -> str:
    ahead = [row for row in figures.rows() if row.verdict == "the run"]
    behind = [row for row in figures.rows() if row.verdict in ("the solver", "the solver alone")]
    parts = [
        f"{who} at {' and '.join(f'{100 * row.tolerance:g} %' for row in rows)}"
        for who, rows in (("the run is faster", ahead), ("the solver is the better choice", behind))
        if rows
    ]
    told = "; ".join(parts) or "neither is faster by the intervals" if figures.solver else "the solver was not run"
    return f"{len(figures.scenes)} scenes that the run has not learned from: {told}."


def _note(figures: TradeFigures) -> str:
    text = (
        f"Of each side the fastest setting counts that keeps the error in {100 * WITHIN:g} % of the scenes, by its"
        " median time. A ratio is the median over the scenes, with an interval of 95 % by bootstrap. Errors are"
        " relative to the displacement at the deepest frame; times are processor time on one thread, with all that is"
        " prepared for a mesh."
    )
    if figures.invested is not None:
        spent = duration(figures.invested)
        text += f" Simulation and training took {spent} of a core; after so many questions they are repaid."
    text += f" {figures.mesh_line}." if figures.mesh_line else ""
    return text + (f" The solver was not run: {figures.no_solver}." if figures.no_solver else "")


def _points(settings: Sequence[Setting]) -> list[dict[str, Any]]:
    """The settings as points; `front` marks those that none beats."""
    best = {one.name for one in front(settings)}
    return [
        {"name": one.name, "error": one.kept, "seconds": one.middle, "front": one.name in best, "command": one.command}
        for one in _answered(settings)
    ]


def _answered(settings: Sequence[Setting]) -> list[Setting]:
    """The settings that have an answer in enough scenes to keep an error, from the fastest to the slowest."""
    return sorted((one for one in settings if math.isfinite(one.kept)), key=lambda one: one.middle)
