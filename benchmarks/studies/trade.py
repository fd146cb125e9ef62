"""What an error costs: runs and the solver at fixed errors, on scenes that no training has seen.

`python -m benchmarks.studies.trade [ROW ...]` makes the scenes of each row, takes the run that comes with the package
or trains one of `benchmarks.studies.jumps` or `benchmarks.studies.assembly`, and measures both sides with
`ast_sim.trade`. It writes benchmarks/results/trade.json and docs/results/trade.md. Data and runs lie in `--folder`.
Everything runs on one thread.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ast_sim
from ast_sim.support.progress import duration
from ast_sim.trade_figures import TradeFigures
from benchmarks.studies import assembly, jumps
from benchmarks.studies.rows import study_rows

RESULTS = Path(__file__).parents[1] / "results" / "trade.json"
PAGE = Path(__file__).parents[2] / "docs" / "results" / "trade.md"
DEEP_PLATES = {"family": "deforming_plate", "frames": 41, "keep": (14, 24, 34)}


@dataclass(frozen=True)
class Row:
    """A run and fresh scenes.

    Attributes:
        title: what the page calls them.
        run: the name of an example run, or of a row of `benchmarks.studies.jumps` or `benchmarks.studies.assembly`.
        scenes: how many are measured.
        plates: the settings of `generate` for fresh plates, which chose nothing; None: the test scenes of the row.
        beside: the row of another model that was trained on the same scenes for the same time.
    """

    title: str
    run: str
    scenes: int
    plates: dict[str, Any] | None = None
    beside: str | None = None


ROWS = {
    "plates400": Row("Plates, 400 nodes", "plates", 40, {**DEEP_PLATES, "nodes": 400, "seed": 912}),
    "plates1300": Row("Plates, 1,300 nodes", "plates1300", 15),
    "plates1300_second_order": Row("Plates, 1,300 nodes, second-order", "plates1300_second_order", 15),
    "parts400": Row("Pairs of parts, 400 nodes, with friction", "parts400_long", 30),
    "snap_hook": Row("Snap hook, second-order elements, with friction", "snap_hook", 15, beside="snap_hook_transolver"),
    "bumper": Row("Bumper, second-order elements, with friction", "bumper", 15),
}


def measured(name: str, folder: Path) -> dict[str, Any]:
    """The figures of a row."""
    run, data, made_from = _run_and_data(name, folder)
    beside = ROWS[name].beside
    others = [] if beside is None else [_trained(beside, folder)[0]]
    command = f"python -m benchmarks.studies.trade {name}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Newton steps that do not end: their errors count
        scenes = ROWS[name].scenes
        by_quantity = ast_sim.trade(
            run, data, scenes=scenes, beside=others, made_from=made_from, command=command
        ).to_json()
    for figures in by_quantity.values():
        figures["origin"] |= {"run": run.path.name, "data": Path(data).name}
    return by_quantity


def _run_and_data(name: str, folder: Path) -> tuple[ast_sim.Run, Path, Path | None]:
    """The run of a row, its scenes, and the specification of which they were made."""
    row = ROWS[name]
    if row.plates is not None:
        data = ast_sim.generate(out=folder / f"{name}_fresh.h5", train=0, valid=0, test=row.scenes, **row.plates).path
        return ast_sim.example_run(row.run), data, None
    return *_trained(row.run, folder), None if row.run in jumps.ROWS else assembly.ROWS[row.run].spec


def _trained(name: str, folder: Path) -> tuple[ast_sim.Run, Path]:
    """The run of a row of `benchmarks.studies.jumps` or `benchmarks.studies.assembly`, and its dataset."""
    return (jumps if name in jumps.ROWS else assembly).trained(name, folder)


def page(results: dict[str, Any]) -> str:
    """The page of all rows that have a result."""
    shown = {
        row.title: {quantity: TradeFigures.from_json(values) for quantity, values in results[name].items()}
        for name, row in ROWS.items()
        if name in results
    }
    lines = [line for title, by_quantity in shown.items() for line in _section(title, by_quantity)]
    return "\n".join([_INTRODUCTION.rstrip(), *lines])


_INTRODUCTION = """# What an error costs

Made by `python -m benchmarks.studies.trade` from `benchmarks/results/trade.json`; do not edit.

On each side the fastest setting counts that keeps the error in 90 % of the scenes, by its median time: of the run the
efforts that it can make, of the solver its variants (stop tests, ranges of contact, coarser meshes, linearised steps,
nested iteration, with friction frame by frame). Neither side may choose scene by scene. Errors are relative, at the
frame in which a scene is deformed most: of the displacement, of the force on the moved body, of the largest stress. A
solution on a coarser mesh gives the force and the stress of that mesh. Times are processor time on one thread, beside
other work on the same machine, with all that is prepared for a mesh; meshing is not counted. A ratio is the median
over the scenes of the solver's time over the run's, with an interval of 95 % by bootstrap over the scenes. Who is
faster follows from the interval. "Pays after" counts simulation and training against the time that an answer saves.

For a run of your own: `ast-sim trade RUN DATA --out trade.html`.
"""


def _section(title: str, by_quantity: dict[str, TradeFigures]) -> list[str]:
    figures = by_quantity["displacement"]
    processor = figures.origin["processor"]
    spent = figures.invested
    trained = "" if spent is None else f" Simulation and training took {duration(spent)} of a core."
    return [
        "",
        f"## {title}",
        "",
        f"{len(figures.scenes)} scenes, {len(figures.solver)} variants of the solver, {processor}.{trained}",
        *(line for one in by_quantity.values() for line in _table(one)),
    ]


def _table(figures: TradeFigures) -> list[str]:
    rows = figures.rows()
    return [
        "",
        f"### {figures.quantity.capitalize()}",
        "",
        f"| {' | '.join(figures.columns)} |",
        f"| ---: |{' --- |' * (len(figures.columns) - 2)} ---: |",
        *(f"| {' | '.join(row.cells)} |" for row in rows),
        "",
        f"The run is ahead in {len(figures.ahead)} of {len(rows)} cells, the solver in {len(figures.behind)}.",
        *(f"{note}." for note in figures.notes),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    study_rows(__doc__, ROWS, arguments, measured, _said, (RESULTS, PAGE), page)


def _said(by_quantity: dict[str, Any]) -> str:
    told = []
    for quantity, values in by_quantity.items():
        figures = TradeFigures.from_json(values)
        told.append(f"{quantity} {len(figures.ahead)} of {len(figures.rows())}")
    return f"cells in which the run is ahead: {', '.join(told)}"


if __name__ == "__main__":
    main()
