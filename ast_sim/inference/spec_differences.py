"""How the specification of a question differs from the one that a run was trained on."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ast_sim.runs.scope import LEEWAY
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec, PartSpec, script_and_function
from ast_sim.simulate.own_assembly.parameters import Values
from ast_sim.simulate.own_assembly.spec_reader import parse_spec

# What other notes tell: the mesh (by the length of its edges), the files by their content, materials by their values.
_TOLD_ELSEWHERE = {"size", "finer", "file", "young", "poisson"}


def differences(spec: AssemblySpec, values: Values, trained: Mapping[str, Any]) -> Iterator[str]:
    """One sentence for each difference.

    Args:
        spec, values: the specification of the question, and the values of its parameters.
        trained: the specification of the training, as `AssemblySpec.describe` gives it.
    """
    known = parse_spec(Path(trained["name"]), trained["text"])
    names = {part.name: part for part in known.parts}
    for part in spec.parts:
        if part.name not in names:
            yield f"the run was trained without the part {part.name}"
        elif not _hashes(spec.describe(), _in_use(part, values)) <= _hashes(trained, names[part.name].files):
            files = ", ".join(names[part.name].files)
            yield f"the run was trained on another file of part {part.name}: {files}, whose content was not this one"
    for name in names.keys() - {part.name for part in spec.parts}:
        yield f"the run was trained with a part {name}"
    yield from _values(spec, values, known)
    mine, theirs = tomllib.loads(spec.text), tomllib.loads(trained["text"])
    for name in sorted(names.keys() & mine["parts"].keys()):
        yield from _keys(f"parts.{name}.", mine["parts"][name], theirs["parts"][name], _TOLD_ELSEWHERE)
    other = {*mine, *theirs} - {"contact", "contact_distance"}
    yield from _keys("", mine, theirs, other)


def _in_use(part: PartSpec, values: Values) -> tuple[str, ...]:
    return (str(values[f"{part.name}.file"]),) if len(part.files) > 1 else part.files


def _hashes(described: Mapping[str, Any], files: tuple[str, ...]) -> set[tuple[str, str]]:
    """The content of each file, and the function that is called if it is a script."""
    split = map(script_and_function, files)
    return {(described["files"][file], function) for file, function in split}


def _values(spec: AssemblySpec, values: Values, known: AssemblySpec) -> Iterator[str]:
    """Values outside of the ranges of the training."""
    for name, value in values.items():
        one = known.parameters.get(name)
        if one is None or isinstance(value, str) or one.choices:
            continue
        if one.formula is not None:
            now = spec.parameters[name].formula
            if now is None or now.text != one.formula.text:
                yield f"{name} is {value:.4g}; in training {one.formula.text!r}"
        elif not one.low - LEEWAY * abs(one.low) <= value <= one.high + LEEWAY * abs(one.high):
            limits = dict.fromkeys((one.low, one.high))
            yield f"{name} is {value:.4g}; in training {' to '.join(f'{limit:.4g}' for limit in limits)}"


def _keys(place: str, mine: Mapping[str, Any], theirs: Mapping[str, Any], without: set[str]) -> Iterator[str]:
    for key in sorted({*mine, *theirs} - without):
        now, then = (f"is {table[key]!r}" if key in table else "is left out" for table in (mine, theirs))
        if now != then:
            yield f"{place}{key} {now}; in training it {then.replace('is ', 'was ', 1)}"
