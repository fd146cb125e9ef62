"""Parts that keep the coordinates and the scale of their file, meshed with an element size of their own.

This module runs in the process of `cad_worker`. A request is a list of parts. Each has `name`, `size` (length of the
elements), `finer` (boxes [x,y,z low, x,y,z high] with a smaller size), `solid` (its name or its number from 1, of a
file that holds several) and one of

    "step": path of a STEP, IGES or BREP file; of a STEP file with "unit", gmsh's name of the unit that it gets
    "stl": path of a surface
    "script": path of a .py file, "function" in it and "arguments" of the call `function(gmsh, **arguments)`
    "geo": path of a .geo script, with "arguments": the values of its numbers (DefineConstant)

With "order" 2, tetrahedra have ten nodes, the middles on the surface of the part. With "surface", a file without a
solid gives triangles. If a part cannot be meshed well, `ATTEMPTS` are made from
"first" on. The answer has own_position_i, own_elements_i, own_notes_i (texts: what was mended), own_factor_i (the size
that was taken, over the wanted one), own_failure_i (why the first attempt failed; empty if it did not) and, for each
physical group of a script, own_group_i_NAME: the numbers of its nodes.
"""

from __future__ import annotations

import math
import runpy
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.importers.formats.stl_file import BadSurface
from ast_sim.simulate.shapes.cad.cad_import import (
    CREASE_ANGLE,
    BadPart,
    import_step,
    pick_solid,
    solid_of_surface,
    start,
    tetrahedra,
    triangles,
)
from ast_sim.simulate.shapes.cad.surface_mend import stl_surface
from ast_sim.simulate.shapes.parts import smallest_dihedral
from ast_sim.support.errors import counted

MOST_NODES = 200_000  # of one part
TRANSITION = 2.0  # length over which elements around a finer box grow to the usual size, in usual sizes
SMALLEST_ANGLE = 1.0  # degrees between two faces of a tetrahedron: enough for the solver


@dataclass(frozen=True)
class Attempt:
    """Settings to mesh a part with.

    Attributes:
        factor: the size of the elements, over the wanted one.
        mend: whether very small edges and faces of a CAD file are removed first.
        crease: smallest angle at an edge of a surface that becomes an edge of the part, in degrees.
        algorithm: gmsh's number of the mesher of the faces.
    """

    factor: float = 1.0
    mend: bool = False
    crease: float = math.degrees(CREASE_ANGLE)
    algorithm: int = 6


NEARBY = (0.93, 1.07, 0.85, 1.15, 0.75, 1.3, 0.6)
# What is tried, in this order: as the file is; mended; by other meshers of faces; with elements of nearly that size.
ATTEMPTS = (
    Attempt(),
    Attempt(mend=True, crease=60),
    Attempt(algorithm=5),
    Attempt(mend=True, algorithm=1, crease=25),
    *(Attempt(factor, mend, algorithm=6 - mend) for factor in NEARBY for mend in (False, True)),
)


@dataclass(frozen=True, eq=False)
class Meshed:
    """The mesh of a part.

    Attributes:
        position: [N,3] float64.
        elements: [E,4], [E,10] of the order 2, or [F,3] of a surface.
        tags: [N] gmsh's numbers of the nodes.
        notes: what was mended, a sentence each.
        factor: the size of the elements, over the wanted one.
        failure: why the first attempt failed; empty if it did not.
    """

    position: np.ndarray
    elements: np.ndarray
    tags: np.ndarray
    notes: tuple[str, ...]
    factor: float
    failure: str


def answer(gmsh, parts: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """The arrays of all parts. Each gets a gmsh of its own: a mesh must not depend on the parts before it.

    Raises:
        BadPart: a part cannot be meshed; the text names it.
    """
    arrays: dict[str, np.ndarray] = {}
    for i, part in enumerate(parts):
        try:
            mesh = _mesh(gmsh, part)
        except Exception as error:  # gmsh raises Exception itself
            raise BadPart(f"{part['name']}: {str(error).strip() or 'gmsh stopped without a message'}") from error
        arrays |= {f"own_position_{i}": mesh.position, f"own_elements_{i}": mesh.elements}
        told = {"notes": np.array(mesh.notes, dtype=str), "factor": mesh.factor, "failure": mesh.failure}
        arrays |= {f"own_{key}_{i}": np.array(value) for key, value in told.items()}
        for dimension, group in gmsh.model.getPhysicalGroups():
            name = gmsh.model.getPhysicalName(dimension, group)
            nodes, _ = gmsh.model.mesh.getNodesForPhysicalGroup(dimension, group)
            arrays[f"own_group_{i}_{name}"] = np.flatnonzero(np.isin(mesh.tags, nodes))
    return arrays


def _mesh(gmsh, part: dict[str, Any]) -> Meshed:
    """The mesh of the first attempt that gives a good one.

    Raises:
        BadPart: none does; the text says why the first does not.
    """
    failures: list[str] = []
    for number, attempt in _attempts(part):
        print(f"{part['name']}: attempt {number}", file=sys.stderr, flush=True)  # the last line if gmsh crashes
        start(gmsh)
        gmsh.model.add("own")
        try:
            notes, solid = _make(gmsh, part, attempt)
            gmsh.option.setNumber("Mesh.Algorithm", attempt.algorithm)
            gmsh.model.mesh.generate(3 if solid else 2)
            if solid:
                notes += _without_slivers(gmsh)
            mesh = tetrahedra(gmsh, part["order"]) if solid else triangles(gmsh)
            return Meshed(*mesh, tuple(notes), attempt.factor, (failures or [""])[0])
        except (BadPart, BadSurface):
            raise
        except Exception as error:  # gmsh raises Exception itself
            failures.append(" ".join(str(error).split()) or "gmsh stopped without a message")
    sizes = [part["size"] * attempt.factor for attempt in ATTEMPTS]
    failures = failures or ["gmsh crashed in every attempt"]
    raise BadPart(
        f"with elements of the size {part['size']:.4g}: {failures[0]}; nor do sizes from {min(sizes):.3g} to"
        f" {max(sizes):.3g} give a mesh: give another size, or remove small faces, gaps and overlaps in its CAD program"
    )


def _attempts(part: dict[str, Any]) -> Iterator[tuple[int, Attempt]]:
    """The attempts from "first" on, with their numbers, without attempts that differ in nothing that this part has."""
    known = set()
    for number, attempt in enumerate(ATTEMPTS):
        settings = (
            attempt.factor,
            attempt.algorithm,
            attempt.mend if "step" in part else attempt.crease if "stl" in part else None,
        )
        if number >= part.get("first", 0) and settings not in known:
            yield number, attempt
        known.add(settings)


class BadElements(Exception):
    """A mesh that is not good enough, in words."""


def _without_slivers(gmsh) -> list[str]:
    """Optimise a mesh that has too sharp elements; return what was done.

    Raises:
        BadElements: there are no elements, or some are still too sharp.
    """
    methods = iter(("Netgen", "Relocate3D", "Netgen"))
    count = 0
    while True:
        if not len(gmsh.model.mesh.getElementsByType(4)[1]):
            raise BadElements("its faces enclose no volume that gmsh finds")
        position, elements, _ = tetrahedra(gmsh)
        angle = smallest_dihedral(position, elements)
        sharp = int((angle < SMALLEST_ANGLE).sum())
        count = count or sharp
        if not sharp:
            return [f"{counted(count, 'sliver')} mended"] if count else []
        method = next(methods, None)
        if method is None:
            raise BadElements(f"{counted(sharp, 'element')} with a dihedral angle of down to {angle.min():.2g} degrees")
        gmsh.model.mesh.optimize(method, force=True)


def _make(gmsh, part: dict[str, Any], attempt: Attempt) -> tuple[list[str], bool]:
    """Make the shape and set the sizes; return what was mended, and whether it is a solid."""
    notes: list[str] = []
    if "stl" in part:
        surface = stl_surface(Path(part["stl"]), part.get("solid"), whole=bool(part.get("surface")))
        solid_of_surface(gmsh, surface, math.radians(attempt.crease))
        notes += surface.notes
    elif "step" in part:
        gmsh.option.setString("Geometry.OCCTargetUnit", part.get("unit", ""))
        try:
            import_step(gmsh, part["step"], attempt.mend)
        except Exception as error:  # gmsh raises Exception itself
            if "Could not read file" in str(error):
                raise BadPart("gmsh cannot read the file: it is damaged, cut off, or no CAD file") from error
            raise
    elif "geo" in part:
        for name, value in part["arguments"].items():
            gmsh.parser.setNumber(name, [value])
        gmsh.merge(part["geo"])
    else:
        _run(gmsh, part)
    gmsh.model.occ.synchronize()
    solid = not part.get("surface") or bool(gmsh.model.getEntities(3))
    if solid:
        pick_solid(gmsh, None if "stl" in part else part.get("solid"))
        _check_count(gmsh, attempt.factor * part["size"], part["order"])
    finer = [{**one, "size": attempt.factor * one["size"]} for one in part["finer"]]
    _set_sizes(gmsh, attempt.factor * part["size"], finer)
    return notes, solid


def _run(gmsh, part: dict[str, Any]) -> None:
    """Call the function of a script of the user."""
    function = part["function"]
    try:
        made = runpy.run_path(part["script"]).get(function)
        if not callable(made):
            raise BadPart(f"the script has no function {function}")
        made(gmsh, **part["arguments"])
    except BadPart:
        raise
    except (Exception, SystemExit) as error:
        given = ", ".join(f"{name}={value:.6g}" for name, value in part["arguments"].items())
        raise BadPart(f"{function}({given}) raised {type(error).__name__}: {error}") from error
    gmsh.model.geo.synchronize()


def _check_count(gmsh, size: float, order: int) -> None:
    """Refuse a size that gives too many nodes before minutes go into them."""
    if gmsh.model.occ.getEntities(3):
        volume, area = (sum(gmsh.model.occ.getMass(*e) for e in gmsh.model.occ.getEntities(d)) for d in (3, 2))
        between = size / order
        nodes = 0.72 * volume / between**3 + 1.4 * area / between**2
        if nodes > MOST_NODES:
            raise BadPart(f"elements of the size {size:g} give about {nodes:,.0f} nodes, more than {MOST_NODES:,}")


def _set_sizes(gmsh, size: float, finer: list[dict[str, Any]]) -> None:
    smallest = min([size, *(one["size"] for one in finer)])
    gmsh.option.setNumber("Mesh.MeshSizeMin", smallest)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    fields = []
    for one in finer:
        field = gmsh.model.mesh.field.add("Box")
        ends = [f"{axis}{end}" for end in ("Min", "Max") for axis in "XYZ"]
        for name, value in zip(ends, one["box"], strict=True):
            gmsh.model.mesh.field.setNumber(field, name, value)
        for name, value in (("VIn", one["size"]), ("VOut", size), ("Thickness", TRANSITION * size)):
            gmsh.model.mesh.field.setNumber(field, name, value)
        fields.append(field)
    if fields:
        least = gmsh.model.mesh.field.add("Min")
        gmsh.model.mesh.field.setNumbers(least, "FieldsList", fields)
        gmsh.model.mesh.field.setAsBackgroundMesh(least)
