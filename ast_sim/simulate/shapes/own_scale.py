"""Parts that keep the coordinates and the scale of their file, meshed with an element size of their own.

This module runs in the process of `cad_worker`. A request is a list of parts. Each has `name`, `size` (length of the
elements), `finer` (boxes [x,y,z low, x,y,z high] with a smaller size) and one of

    "step": path, with "unit" (gmsh's name of the unit of length that its coordinates get)
    "stl": path of a closed surface
    "script": path of a .py file, "function" in it and "arguments" of the call `function(gmsh, **arguments)`
    "geo": path of a .geo script, with "arguments": the values of its numbers (DefineConstant)

With "order" 2, tetrahedra have ten nodes, the middles on the surface of the part. With "surface", a STEP file without a
solid gives triangles. The answer has own_position_i, own_elements_i and, for each
physical group of a script, own_group_i_NAME: the numbers of its nodes.
"""

from __future__ import annotations

import runpy
from typing import Any

import numpy as np

from ast_sim.simulate.shapes.cad_import import (
    BadPart,
    import_step,
    one_solid,
    solid_of_surface,
    start,
    surface_triangles,
    tetrahedra,
    triangles,
)

MOST_NODES = 200_000  # of one part
TRANSITION = 2.0  # around a finer box the elements grow to the usual size over so many of these


def answer(gmsh, parts: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    """The arrays of all parts. Each gets a gmsh of its own: a mesh must not depend on the parts before it.

    Raises:
        BadPart: a part cannot be meshed; the text names it.
    """
    arrays = {}
    for i, part in enumerate(parts):
        start(gmsh)
        try:
            solid = _mesh(gmsh, part)
            position, elements, tags = tetrahedra(gmsh, part["order"]) if solid else triangles(gmsh)
        except Exception as error:  # gmsh raises Exception itself
            raise BadPart(f"{part['name']}: {str(error).strip() or 'gmsh stopped without a message'}") from error
        arrays |= {f"own_position_{i}": position, f"own_elements_{i}": elements}
        for dimension, group in gmsh.model.getPhysicalGroups():
            name = gmsh.model.getPhysicalName(dimension, group)
            nodes, _ = gmsh.model.mesh.getNodesForPhysicalGroup(dimension, group)
            arrays[f"own_group_{i}_{name}"] = np.flatnonzero(np.isin(tags, nodes))
    return arrays


def _mesh(gmsh, part: dict[str, Any]) -> bool:
    """Make and mesh a part, a STEP file first as it is and then mended; return whether it is a solid."""
    failures: list[Exception] = []
    for mend in (False, True) if "step" in part else (False,):
        gmsh.model.add("own")
        solid = _make(gmsh, part, mend)
        try:
            gmsh.model.mesh.generate(3 if solid else 2)
            return solid
        except Exception as error:  # gmsh raises Exception itself
            failures.append(error)
            gmsh.model.remove()
    text = str(failures[0]).strip() or "gmsh stopped without a message"
    raise BadPart(f"with elements of the size {part['size']:.4g}: {text}; another size may do") from failures[0]


def _make(gmsh, part: dict[str, Any], mend: bool) -> bool:
    """Make the shape and set the sizes; return whether it is a solid."""
    if "stl" in part:
        gmsh.merge(part["stl"])
        if not len(surface_triangles(gmsh)):
            raise BadPart("it holds no triangles")
        solid_of_surface(gmsh)
    elif "step" in part:
        gmsh.option.setString("Geometry.OCCTargetUnit", part["unit"])
        import_step(gmsh, part["step"], mend)
    elif "geo" in part:
        for name, value in part["arguments"].items():
            gmsh.parser.setNumber(name, [value])
        gmsh.merge(part["geo"])
    else:
        _run(gmsh, part)
    gmsh.model.occ.synchronize()
    solid = not part.get("surface") or bool(gmsh.model.getEntities(3))
    if solid:
        one_solid(gmsh)
        _check_count(gmsh, part["size"], part["order"])
    _set_sizes(gmsh, part["size"], part["finer"])
    return solid


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
