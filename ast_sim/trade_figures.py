"""Speed against accuracy on the same scenes: the settings of a run and of the solver, and who is faster at an error.

A setting keeps an error if at least `WITHIN` of the scenes are within it. At each tolerance the setting that keeps it
and has the smallest median time counts, on both sides. Errors are relative and at the deepest frame: of the
displacement, of the reaction (the force on the driven nodes) or of the largest stress.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any, Self

import numpy as np

TOLERANCES = (0.1, 0.05, 0.025, 0.01, 0.005, 0.002)
WITHIN = 0.9
COLUMNS = ("error at most", "the run", "the solver", "solver / run", "faster", "pays after")  # of `TradeRow.cells`
RESAMPLES = 2000  # of the bootstrap over scenes


@dataclass(frozen=True)
class Setting:
    """An effort of the run, or a way to run the solver.

    Attributes:
        name: such as "0 corrections, up to 1 Newton step".
        errors, seconds: of each scene, on one thread; infinite where there is no answer.
        command: what repeats an answer of the run; empty for the solver.
    """

    name: str
    errors: tuple[float, ...]
    seconds: tuple[float, ...]
    command: str = ""

    @property
    def kept(self) -> float:
        """The smallest error that at least `WITHIN` of the scenes are within."""
        return sorted(self.errors)[math.ceil(WITHIN * len(self.errors) - 1e-9) - 1]

    @property
    def middle(self) -> float:
        """The median of the seconds."""
        return median(self.seconds)


@dataclass(frozen=True)
class TradeRow:
    """What an error costs.

    Attributes:
        tolerance: the error.
        run, solver: the fastest setting that keeps it; None: none does.
        ratio: the median over the scenes of the solver's seconds over those of the run; None: one of them is missing.
        low, high: an interval of 95 % of the ratio, by bootstrap over the scenes.
        pays_after: the questions after which simulation and training are repaid; None: never, or not known.
    """

    tolerance: float
    run: Setting | None
    solver: Setting | None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    pays_after: int | None = None

    @property
    def verdict(self) -> str:
        """Who is faster, by the interval."""
        if self.run is None or self.solver is None:
            return "none keeps it" if self.run is self.solver else ("only the run" if self.run else "the solver alone")
        assert self.low is not None and self.high is not None
        return "the run" if self.low > 1 else "the solver" if self.high < 1 else "level"

    @property
    def cells(self) -> list[str]:
        """The error, both settings, the ratio, the verdict and when it pays, as texts of a table."""
        both = ["none" if one is None else f"{1000 * one.middle:.3g} ms: {one.name}" for one in (self.run, self.solver)]
        ratio = "–" if self.ratio is None else f"{self.ratio:.2f} ({self.low:.2f} to {self.high:.2f})"
        pays = "–" if self.pays_after is None else f"{self.pays_after:,} questions"
        return [f"{100 * self.tolerance:g} %", *both, ratio, self.verdict, pays]


@dataclass(frozen=True)
class TradeFigures:
    """The settings on the same scenes.

    Attributes:
        scenes: the names of the scenes.
        run, solver: the settings; no solver: `no_solver` says why.
        mesh_errors: of some scenes, how far the solver's frame is from the one on a mesh of 8 times the nodes,
            of the quantity; empty: not known.
        invested: the seconds of simulation and training before the first answer; None: not known.
        origin: command, commit, processor, run and dataset.
        quantity: what the errors are of: "displacement", "reaction" or "stress".
    """

    scenes: tuple[str, ...]
    run: tuple[Setting, ...]
    solver: tuple[Setting, ...]
    no_solver: str = ""
    mesh_errors: tuple[float, ...] = ()
    invested: float | None = None
    origin: dict[str, Any] = field(default_factory=dict)
    quantity: str = "displacement"

    def rows(self) -> list[TradeRow]:
        """A row for each of `TOLERANCES`."""
        return [self._row(tolerance) for tolerance in TOLERANCES]

    @property
    def ahead(self) -> list[TradeRow]:
        """The rows in which the run is faster."""
        return [row for row in self.rows() if row.verdict == "the run"]

    @property
    def behind(self) -> list[TradeRow]:
        """The rows in which the solver is faster, or alone keeps the error."""
        return [row for row in self.rows() if row.verdict in ("the solver", "the solver alone")]

    def _row(self, tolerance: float) -> TradeRow:
        run = _fastest(self.run, tolerance)
        solver = _fastest(self.solver, tolerance)
        if run is None or solver is None:
            return TradeRow(tolerance, run, solver)
        ratios = np.array(solver.seconds) / np.array(run.seconds)
        drawn = np.random.default_rng(0).integers(len(ratios), size=(RESAMPLES, len(ratios)))
        low, high = np.quantile(np.median(ratios[drawn], axis=1), (0.025, 0.975))
        saved = solver.middle - run.middle
        known = self.invested is not None and saved > 0
        pays = math.ceil(self.invested / saved) if known and self.invested is not None else None
        return TradeRow(tolerance, run, solver, float(np.median(ratios)), float(low), float(high), pays)

    @property
    def mesh_error(self) -> float | None:
        """The median of `mesh_errors`. An answer with a smaller error is no nearer to the truth."""
        return median(self.mesh_errors) if self.mesh_errors else None

    @property
    def mesh_line(self) -> str:
        """One sentence on the error of the mesh itself; empty: it is not known."""
        if self.mesh_error is None:
            return ""
        scenes = f"{len(self.mesh_errors)} scene{'s' * (len(self.mesh_errors) > 1)}"
        return (
            f"The mesh alone makes the {self.quantity} {100 * self.mesh_error:.2g} % wrong (median of {scenes}, against"
            " 8 times the nodes): an answer with a smaller error is no nearer to the truth"
        )

    def lines(self) -> list[str]:
        """The table as text."""
        counts = f"{len(self.scenes)} scenes, deepest frame, one thread"
        told = [f"{counts}; error of the {self.quantity} kept in {100 * WITHIN:g} % of them"]
        for row in self.rows():
            parts = [_told("run", row.run), _told("solver", row.solver)]
            if row.ratio is not None:
                parts.append(f"ratio {row.ratio:.2f} ({row.low:.2f} to {row.high:.2f}): {row.verdict}")
            if row.pays_after is not None:
                parts.append(f"pays after {row.pays_after:,} questions")
            told.append(f"{100 * row.tolerance:g} %: {'; '.join(parts)}")
        told += [self.mesh_line] if self.mesh_line else []
        return told + ([f"the solver was not run: {self.no_solver}"] if self.no_solver else [])

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `to_json` gave."""
        known = {key: values[key] for key in ("no_solver", "invested", "origin", "quantity")}
        known["mesh_errors"] = tuple(values["mesh_errors"])
        run, solver = (tuple(map(_setting, values[side])) for side in ("run", "solver"))
        return cls(tuple(values["scenes"]), run, solver, **known)

    def to_json(self) -> dict[str, Any]:
        """All figures; an infinite number is null."""
        settings = {
            side: [
                {**asdict(one), "errors": _finite(one.errors), "seconds": _finite(one.seconds)}
                for one in getattr(self, side)
            ]
            for side in ("run", "solver")
        }
        rows = [
            {
                **asdict(row),
                "run": None if row.run is None else row.run.name,
                "solver": None if row.solver is None else row.solver.name,
                "verdict": row.verdict,
            }
            for row in self.rows()
        ]
        return {**asdict(self), **settings, "rows": rows}


def front(settings: Sequence[Setting]) -> list[Setting]:
    """The settings that none beats in both time and kept error, from the fastest to the most accurate."""
    best: list[Setting] = []
    for one in sorted(settings, key=lambda one: (one.middle, one.kept)):
        if math.isfinite(one.kept) and math.isfinite(one.middle) and (not best or one.kept < best[-1].kept):
            best.append(one)
    return best


def _fastest(settings: Sequence[Setting], tolerance: float) -> Setting | None:
    fit = [one for one in settings if one.kept <= tolerance and math.isfinite(one.middle)]
    return min(fit, key=lambda one: one.middle, default=None)


def _told(who: str, setting: Setting | None) -> str:
    return f"{who}: none" if setting is None else f"{who}: {1000 * setting.middle:.3g} ms ({setting.name})"


def _setting(values: Mapping[str, Any]) -> Setting:
    errors, seconds = (tuple(math.inf if one is None else one for one in values[key]) for key in ("errors", "seconds"))
    return Setting(values["name"], errors, seconds, values["command"])


def _finite(values: Sequence[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]
