"""The page of a trade: the error against the seconds of an answer, and what each error costs."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

from ast_sim.number_arrays import measured_time, percent
from ast_sim.support.errors import counted
from ast_sim.support.progress import duration
from ast_sim.trade_figures import WITHIN, Setting, TradeFigures, front
from ast_sim.view import page
from ast_sim.view.encode import finite_json


def write(path: str | os.PathLike[str], figures: Sequence[TradeFigures], title: str) -> None:
    """Write the page of the figures of each quantity; the first is drawn. Errors as in `page.write`."""
    page.write(path, page_data(*figures), title)


def page_data(figures: TradeFigures, *others: TradeFigures) -> dict[str, Any]:
    """Everything that the page's scripts show, as JSON."""
    return finite_json(
        {
            "kind": "trade",
            "lead": _lead(figures),
            "tiles": [],
            "sides": [
                {"name": "The run", "points": _points(figures.run)},
                {"name": "The solver", "points": _points(figures.solver)},
                *({"name": side.name, "points": _points(side.settings)} for side in figures.others),
            ],
            "mesh": figures.mesh_error,
            "tables": [_table(one) for one in (figures, *others)],
            "note": _note(figures),
            "settings": _settings([figures, *others]),
            "facts": [[key.capitalize(), str(value)] for key, value in figures.origin.items()],
            "footer": page.FOOTER,
        }
    )


def _table(figures: TradeFigures) -> dict[str, Any]:
    """What each error of a quantity costs."""
    others = {side.name for side in figures.others}
    columns = [name if name in others else name.capitalize() for name in figures.columns]
    rows = [row.cells for row in figures.rows()]
    notes = [f"{note}." for note in figures.notes]
    return {"name": figures.quantity.capitalize(), "columns": columns, "rows": rows, "notes": notes}


def _settings(figures: Sequence[TradeFigures]) -> dict[str, Any]:
    """A table of all settings that have an answer, with the error of each quantity that they keep."""
    columns = ["Side", "Setting", *(f"{one.quantity.capitalize()} kept" for one in figures), "Median time", "Command"]
    rows = []
    sides = [_sides(one) for one in figures]
    for place, (side, _) in enumerate(sides[0]):
        of_quantities = (of_side[place][1] for of_side in sides)
        for same in sorted(zip(*of_quantities, strict=True), key=lambda same: same[0].middle):
            kept = [setting.kept for setting in same]
            if any(map(math.isfinite, kept)):
                errors = [percent(error, 3) if math.isfinite(error) else "–" for error in kept]
                time = measured_time(same[0].middle)
                rows.append([side, same[0].name, *errors, time, same[0].command or "–"])
    return {"columns": columns, "rows": rows}


def _sides(figures: TradeFigures) -> list[tuple[str, tuple[Setting, ...]]]:
    """The name and the settings of each side; the folder of another run may be called "the run"."""
    others = ((side.name, side.settings) for side in figures.others)
    return [("the run", figures.run), ("the solver", figures.solver), *others]


def _lead(figures: TradeFigures) -> str:
    parts = [
        f"{who} at {' and '.join(f'{100 * row.tolerance:g} %' for row in rows)}"
        for who, rows in (("the run is faster", figures.ahead), ("the solver is the better choice", figures.behind))
        if rows
    ]
    told = "; ".join(parts) or "neither is faster by the intervals" if figures.solver else "the solver was not run"
    return (
        f"{counted(len(figures.scenes), 'scene')} that the run has not learned from. {figures.quantity.capitalize()}:"
        f" {told}."
    )


def _note(figures: TradeFigures) -> str:
    text = (
        "For the run and for the solver, the fastest setting counts that keeps the error in"
        f" {100 * WITHIN:g} % of the scenes, by its median time. A ratio is the median over the scenes, with an"
        " interval of 95 % by bootstrap. Errors are relative, at the deepest frame; the stress is the largest one."
        " Times are processor time on one thread, with all that is prepared for a mesh."
    )
    if figures.invested is not None:
        spent = duration(figures.invested)
        text += (
            f" Simulation and training took {spent} of a core; the last column says which number of answers repays it."
        )
    return text


def _points(settings: Sequence[Setting]) -> list[dict[str, Any]]:
    """The settings as points; `front` marks the settings that no other beats."""
    best = {one.name for one in front(settings)}
    return [
        {"name": one.name, "error": one.kept, "seconds": one.middle, "front": one.name in best, "command": one.command}
        for one in _answered(settings)
    ]


def _answered(settings: Sequence[Setting]) -> list[Setting]:
    """The settings that have an answer in enough scenes to keep an error, from the fastest to the slowest."""
    return sorted((one for one in settings if math.isfinite(one.kept)), key=lambda one: one.middle)
