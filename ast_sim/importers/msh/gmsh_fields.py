"""The fields in a `.msh` file of Gmsh, and the frames that their steps and times make.

Gmsh writes each step of a view as a section of its own ($NodeData, $ElementData), with the name of the view, a time and
the number of the step; each partition of a mesh may have its own, too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ast_sim.importers.formats.source_mesh import SourceMesh
from ast_sim.support.errors import DatasetError, counted

# The beginning of a section with a field: one text, which is its name, one real number, the time, and the step.
_HEADER = re.compile(
    rb"\$(NodeData|ElementData)\s+1\s+(\"[^\"]*\"|\S+)\s+1\s+([-+.0-9eEdD]+)\s+[0-9]+\s+([0-9]+)\s", re.ASCII
)

Step = tuple[float, int]  # the time, and the number of the step


class GmshField(NamedTuple):
    """A section with a field: numbers [n] of nodes or elements, and values [n, columns]."""

    of_nodes: bool
    name: str
    number: int
    time: float
    numbers: np.ndarray
    values: np.ndarray

    @property
    def key(self) -> tuple[bool, str]:
        return self.of_nodes, self.name

    @property
    def step(self) -> Step:
        return self.time, self.number


def has_steps(path: Path) -> bool:
    """Whether a file holds a field at several steps, so that it has several frames."""
    headers = {match.groups() for match in _HEADER.finditer(path.read_bytes())}
    return len({header[:2] for header in headers}) < len(headers)


def with_fields(
    mesh: SourceMesh, nodes: np.ndarray, elements: Sequence[np.ndarray], fields: Sequence[GmshField]
) -> Iterator[SourceMesh]:
    """The frames of a mesh, one for each step of its fields. A field of one step is in the frame of this step, or in
    the first one.

    Args:
        nodes: the numbers of the points.
        elements: the numbers of the cells of each block.

    Raises:
        DatasetError: fields are of different steps.
    """
    by_field: dict[tuple[bool, str], dict[Step, list[GmshField]]] = {}
    for one in fields:
        by_field.setdefault(one.key, {}).setdefault(one.step, []).append(one)
    steps = _steps(mesh.path, by_field)
    timed = bool(fields) and (len(steps) == 1 or steps[0][0] < steps[-1][0])
    for frame, step in enumerate(steps):
        points: dict[str, np.ndarray] = {}
        cells = dict(mesh.cell_fields)
        for (of_nodes, name), parts in by_field.items():
            alone = frame == 0 and len(parts) == 1 and not parts.keys() & set(steps)
            there = next(iter(parts.values())) if alone else parts.get(step)
            if there is None:
                continue
            numbers, values = _together(mesh.path, name, there)
            if of_nodes:
                points[name] = _placed(numbers, values, nodes)
            else:
                cells[name] = [_placed(numbers, values, block) for block in elements]
        notes = [*mesh.notes] if frame == 0 else []
        yield replace(mesh, point_fields=points, cell_fields=cells, time=step[0] if timed else None, notes=notes)


def _steps(path: Path, by_field: dict[tuple[bool, str], dict[Step, list[GmshField]]]) -> list[Step]:
    """The steps of the frames: the ones of the fields that have several; else one, at the time that all fields have
    which are not of the time 0."""
    several = {name: tuple(parts) for (_, name), parts in by_field.items() if len(parts) > 1}
    if not several:
        times = sorted({time for parts in by_field.values() for time, _ in parts if time != 0})
        if len(times) > 1:
            raise DatasetError(
                f"{path}: its fields are of different times ({times[0]:g}, {times[1]:g}): write the fields of one frame"
            )
        return [(times[0] if times else 0.0, -1)]  # no field has this number
    (first, usual), *others = several.items()
    other = next((name for name, steps in others if set(steps) != set(usual)), None)
    if other is not None:
        raise DatasetError(
            f"{path}: the field {first!r} has {counted(len(usual), 'step')}, from step {usual[0][1]} at the time"
            f" {usual[0][0]:g} on, {other!r} has {len(several[other])}, from step {several[other][0][1]} at"
            f" {several[other][0][0]:g} on: write all fields at the same steps and times"
        )
    steps = sorted(usual)
    times, numbers = (list(column) for column in zip(*steps, strict=True))
    if len(set(times)) in (1, len(times)) and (len(set(numbers)) == 1 or numbers == sorted(set(numbers))):
        return steps
    raise DatasetError(
        f"{path}: the steps of {first!r} do not ascend with their times: {numbers[:6]} at {times[:6]}; write each step"
        " once, at a time of its own"
    )


def _together(path: Path, name: str, parts: Sequence[GmshField]) -> tuple[np.ndarray, np.ndarray]:
    """The numbers and values of a field at a step, from the sections of all partitions."""
    if len({one.values.shape[1] for one in parts}) > 1:
        raise DatasetError(f"{path}: the field {name!r} has other columns in other sections of one step")
    numbers = np.concatenate([one.numbers for one in parts])
    values = np.concatenate([one.values for one in parts])
    unique, first, row = np.unique(numbers, return_index=True, return_inverse=True)
    differ = (values != values[first[row.ravel()]]).any(axis=1)
    if len(unique) < len(numbers) and differ.any():
        raise DatasetError(
            f"{path}: the field {name!r} has two values for {counted(differ.sum(), 'number')}, such as"
            f" {numbers[np.argmax(differ)]}, at one step and time: give each step a number or a time of its own"
        )
    return numbers, values


def _placed(numbers: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """[wanted, columns]: the value of each of the wanted numbers, NaN where there is none."""
    placed = np.full((len(wanted), values.shape[1]), np.nan)
    order = np.argsort(wanted, kind="stable")
    if len(wanted):
        row = np.minimum(np.searchsorted(wanted[order], numbers), len(wanted) - 1)
        there = wanted[order][row] == numbers
        placed[order[row[there]]] = values[there]
    return placed[:, 0] if values.shape[1] == 1 else placed
