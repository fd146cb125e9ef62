"""Speed against accuracy on the same scenes: the settings of a run, of the solver and of others, and who is faster.

A setting keeps an error if at least `WITHIN` of the scenes are within it. At each tolerance the setting that keeps it
and has the smallest median time counts, on every side. Errors are relative and at the deepest frame: of the
displacement, of the reaction (the force on the driven nodes) or of the largest stress.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import fmean, median
from typing import Any, Self

import numpy as np

from ast_sim.number_arrays import measured_time, percent
from ast_sim.support.errors import counted

TOLERANCES = (0.1, 0.05, 0.025, 0.01, 0.005, 0.002)
WITHIN = 0.9
SKEWED = 1.5  # a mean that is this many times the median is told
RESAMPLES = 2000  # of the bootstrap over scenes
FEWEST = 6  # scenes: the range of n ratios holds their true median with 1 - 2 / 2**n, 97 % of 6 scenes, 94 % of 5


@dataclass(frozen=True)
class Setting:
    """An effort of the run, or a variant of the solver.

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

    @property
    def time(self) -> str:
        """The median of the seconds as text, and their mean where that is much larger: in some scenes, such as those
        that the solver ends, a setting may take far longer than in most."""
        answered = [seconds for seconds in self.seconds if math.isfinite(seconds)]
        mean = fmean(answered) if answered else math.inf
        return measured_time(self.middle) + (f" (mean {measured_time(mean)})" if mean > SKEWED * self.middle else "")


@dataclass(frozen=True)
class Side:
    """What stands beside the run and the solver, such as another run that has learned from the same dataset."""

    name: str
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class TradeRow:
    """What an error costs.

    Attributes:
        tolerance: the error.
        run, solver: the fastest setting that keeps it; None: none does.
        ratio: the median over the scenes of the solver's seconds over the run's; None: one of them is missing.
        low, high: an interval of 95 % of the ratio, by bootstrap over the scenes.
        pays_after: the questions after which simulation and training are repaid; None: never, or not known.
        others: the same setting of each other side, by its name.
    """

    tolerance: float
    run: Setting | None
    solver: Setting | None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    pays_after: int | None = None
    others: Mapping[str, Setting | None] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """Who is faster, by the interval."""
        if self.run is None or self.solver is None:
            if self.run is self.solver:
                return "neither keeps it"
            return "only the run" if self.run else "the solver alone"
        assert self.low is not None and self.high is not None
        return "the run" if self.low > 1 else "the solver" if self.high < 1 else "level"

    @property
    def cells(self) -> list[str]:
        """The error, the setting of each side, the ratio, the verdict and when it pays, as texts of a table."""
        sides = (self.run, self.solver, *self.others.values())
        settings = ["none" if one is None else f"{one.time}: {one.name}" for one in sides]
        ratio = "–" if self.ratio is None else f"{self.ratio:.2f} ({self.low:.2f} to {self.high:.2f})"
        pays = "–" if self.pays_after is None else counted(self.pays_after, "question")
        return [f"{100 * self.tolerance:g} %", *settings, ratio, self.verdict, pays]


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
        others: what else was measured on the same scenes.
        no_process: why no Gaussian process is among them, or none of this quantity.
    """

    scenes: tuple[str, ...]
    run: tuple[Setting, ...]
    solver: tuple[Setting, ...]
    no_solver: str = ""
    mesh_errors: tuple[float, ...] = ()
    invested: float | None = None
    origin: dict[str, Any] = field(default_factory=dict)
    quantity: str = "displacement"
    others: tuple[Side, ...] = ()
    no_process: str = ""

    @property
    def columns(self) -> list[str]:
        """What stands above `TradeRow.cells`."""
        sides = ["the run", "the solver", *(side.name for side in self.others)]
        return ["error at most", *sides, "solver / run", "faster", "pays after"]

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
        others = {side.name: _fastest(side.settings, tolerance) for side in self.others}
        if run is None or solver is None:
            return TradeRow(tolerance, run, solver, others=others)
        ratio, low, high = _ratio(solver, run)
        saved = solver.middle - run.middle
        known = self.invested is not None and saved > 0
        pays = math.ceil(self.invested / saved) if known and self.invested is not None else None
        return TradeRow(tolerance, run, solver, ratio, low, high, pays, others)

    @property
    def ahead_of_run(self) -> dict[str, list[float]]:
        """The other sides that are faster than the run by the interval, or keep an error that it does not, and the
        errors at which they are."""
        ahead: dict[str, list[float]] = {}
        for row in self.rows():
            for name, setting in row.others.items():
                if setting is not None and (row.run is None or _ratio(setting, row.run)[2] < 1):
                    ahead.setdefault(name, []).append(row.tolerance)
        return ahead

    @property
    def notes(self) -> list[str]:
        """Sentences below a table, without full stops."""
        told = [f"The solver was not run: {self.no_solver}"] if self.no_solver else []
        if len(self.scenes) < FEWEST:
            told.append(
                f"{counted(len(self.scenes), 'scene is', 'scenes are')} too few: no interval of 95 % comes from fewer"
                f" than {FEWEST}, so who is faster here may be slower in other scenes"
            )
        told += [f"{name} is ahead of the run at {_at(errors)}" for name, errors in self.ahead_of_run.items()]
        told += [self.mesh_line] if self.mesh_line else []
        return told + ([f"No Gaussian process: {self.no_process}"] if self.no_process else [])

    @property
    def mesh_error(self) -> float | None:
        """The median of `mesh_errors`. An answer with a smaller error is no nearer to the truth."""
        return median(self.mesh_errors) if self.mesh_errors else None

    @property
    def mesh_line(self) -> str:
        """One sentence on the error of the mesh itself; empty: it is not known."""
        if self.mesh_error is None:
            return ""
        scenes = counted(len(self.mesh_errors), "scene")
        return (
            f"The mesh alone makes the {self.quantity} {percent(self.mesh_error)} wrong (median of {scenes}, against"
            " 8 times the nodes): an answer with a smaller error is no nearer to the truth"
        )

    def lines(self) -> list[str]:
        """The table as text."""
        counts = f"{counted(len(self.scenes), 'scene')}, deepest frame, one thread"
        told = [f"{counts}; error of the {self.quantity} kept in {100 * WITHIN:g} % of them"]
        for row in self.rows():
            sides = (("the run", row.run), ("the solver", row.solver), *row.others.items())
            parts = [_told(who, setting) for who, setting in sides]
            if row.ratio is not None:
                parts.append(f"ratio {row.ratio:.2f} ({row.low:.2f} to {row.high:.2f}): {row.verdict}")
            if row.pays_after is not None:
                parts.append(f"pays after {counted(row.pays_after, 'question')}")
            told.append(f"{100 * row.tolerance:g} %: {'; '.join(parts)}")
        return told + self.notes

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `to_json` gave."""
        known = {key: values[key] for key in ("no_solver", "no_process", "invested", "origin", "quantity")}
        known["mesh_errors"] = tuple(values["mesh_errors"])
        known["others"] = tuple(Side(side["name"], _settings(side["settings"])) for side in values["others"])
        run, solver = (_settings(values[side]) for side in ("run", "solver"))
        return cls(tuple(values["scenes"]), run, solver, **known)

    def to_json(self) -> dict[str, Any]:
        """All figures; an infinite number is null."""
        settings = {
            "run": _as_json(self.run),
            "solver": _as_json(self.solver),
            "others": [{"name": side.name, "settings": _as_json(side.settings)} for side in self.others],
        }
        rows = [
            {
                **asdict(row),
                "run": _name(row.run),
                "solver": _name(row.solver),
                "others": {name: _name(setting) for name, setting in row.others.items()},
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


def _ratio(one: Setting, other: Setting) -> tuple[float, float, float]:
    """The median over the scenes of one's seconds over the other's, and its interval of 95 %. Where neither has an
    answer they are level."""
    seconds, others = np.array(one.seconds), np.array(other.seconds)
    ratios = np.divide(seconds, others, out=np.ones(len(seconds)), where=np.isfinite(seconds) | np.isfinite(others))
    drawn = np.random.default_rng(0).integers(len(ratios), size=(RESAMPLES, len(ratios)))
    low, high = np.quantile(np.median(ratios[drawn], axis=1), (0.025, 0.975))
    return float(np.median(ratios)), float(low), float(high)


def _at(errors: Sequence[float]) -> str:
    return " and ".join(f"{100 * error:g} %" for error in errors)


def _told(who: str, setting: Setting | None) -> str:
    return f"{who}: none" if setting is None else f"{who}: {setting.time} ({setting.name})"


def _settings(values: Sequence[Mapping[str, Any]]) -> tuple[Setting, ...]:
    return tuple(
        Setting(one["name"], _numbers(one["errors"]), _numbers(one["seconds"]), one["command"]) for one in values
    )


def _as_json(settings: Sequence[Setting]) -> list[dict[str, Any]]:
    return [{**asdict(one), "errors": _finite(one.errors), "seconds": _finite(one.seconds)} for one in settings]


def _name(setting: Setting | None) -> str | None:
    return None if setting is None else setting.name


def _numbers(values: Sequence[float | None]) -> tuple[float, ...]:
    return tuple(math.inf if value is None else value for value in values)


def _finite(values: Sequence[float]) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in values]
