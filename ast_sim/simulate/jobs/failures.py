"""Which scenes the solver did not finish, and where in the ranges of a specification they lie."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from ast_sim.dataset.reader import Dataset
from ast_sim.simulate.jobs.samples import sample_name
from ast_sim.simulate.own_assembly.parameters import Parameter, Values, told, values_of
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.errors import counted

MOST = 10  # scenes that are told one by one


def failures(dataset: Path, path: Path | None) -> Iterator[str]:
    """What to tell of the scenes that stopped early: for an assembly with the specification at `path`, a line on each
    up to `MOST`, then one on the ranges in which they lie; else their names."""
    with Dataset(dataset) as data:
        samples = [(split, index) for split, count in data.splits.items() for index in range(count)]
        attributes = {sample_name(*sample): data.attributes(*sample) for sample in samples}
    stopped = {name: one for name, one in attributes.items() if one["status"] == "truncated"}
    if path is None:
        yield f"stopped before their last frame: {', '.join(stopped)}"
        return
    spec = read_spec(path)
    for name, one in list(stopped.items())[:MOST]:
        yield f"{name} ({told(spec.parameters, values_of(one))}) stopped at {one.get('stopped_by', 'an unknown frame')}"
    values = [values_of(one) for one in stopped.values()]
    lie = "; ".join(_span(one, values) for one in spec.parameters.values() if one.is_drawn)
    share = f"{len(stopped)} of {counted(len(samples), 'scene')} stopped before their last frame"
    yield f"{share}, at {lie}" if lie else share


def _span(one: Parameter, values: list[Values]) -> str:
    """Between which values of a parameter scenes lie, and between which it is drawn."""
    mine = [value[one.name] for value in values]
    if one.choices:
        return f"{one.name} " + ", ".join(f"{choice} ({mine.count(choice)})" for choice in one.choices)
    return f"{one.name} {min(mine):.4g} to {max(mine):.4g} of {one.low:.4g} to {one.high:.4g}"
