"""The meshes of the parts in the coordinates of their files, times their scale."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.layout import LENGTH_UNITS
from ast_sim.element_topology import MIDDLES, linear_elements, shortest_edge
from ast_sim.importers.formats.stl_file import BadSurface
from ast_sim.importers.mesh_file import read_mesh
from ast_sim.importers.places import Place, marked
from ast_sim.simulate.own_assembly.assembly_spec import (
    CAD_ENDINGS,
    IGES_ENDINGS,
    SCRIPT_ENDINGS,
    STEP_ENDINGS,
    STL_ENDING,
    AssemblySpec,
    PartSpec,
    script_and_function,
)
from ast_sim.simulate.own_assembly.parameters import Values
from ast_sim.simulate.shapes.cad.gmsh_process import gmsh_version, mesh_own_scale
from ast_sim.simulate.shapes.cad.surface_mend import TriangleSurface, stl_surface, whole_surface
from ast_sim.simulate.shapes.mesh import second_order, straightened
from ast_sim.simulate.shapes.mesh_check import BadMesh, check_mesh, check_no_intersections, check_surface
from ast_sim.simulate.shapes.parts import oriented, volumes
from ast_sim.support.errors import ConfigError, MissingExtra, counted, nearest_name

SMALLEST_ANGLE = 1.0  # degrees between two faces of a tetrahedron: enough for the solver
MESHES_KEPT = 64
UNITS = {"m": "M", "cm": "CM", "mm": "MM", "um": "UM", "in": "INCH"}  # gmsh's names
MILLIMETRE = 1e-3  # what gmsh gives for IGES files, whatever their unit, in metres

_kept: dict[str, PartMesh] = {}


@dataclass(frozen=True, eq=False)
class PartMesh:
    """The mesh of a part.

    Attributes:
        name: the name of the part and of its file, for messages.
        position: [N,3] float64 in the unit of the specification.
        cells: [E,4] or [E,10] tetrahedra of positive volume; [F,3] triangles of a rigid surface.
        groups: numbers of the nodes of each named group.
        fields: [N] values of each point field.
        notes: what a user should know of it, a sentence each.
    """

    name: str
    position: np.ndarray
    cells: np.ndarray
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    fields: dict[str, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def nodes_in(self, places: tuple[Place, ...], key: str) -> np.ndarray:
        """[N] bool: the nodes in any of the places.

        Raises:
            ConfigError: a place holds no node, or there is no such field or group; the text begins with `key`.
        """
        nodes = np.zeros(len(self.position), bool)
        shortest = shortest_edge(self.position, self.cells)
        for place in places:
            inside = place.inside(
                self.position,
                lambda name: marked(self._known("field", name, key)),
                lambda name: np.isin(np.arange(len(self.position)), self._known("group", name, key)),
                shortest,
            )
            if not inside.any():
                ends = zip("xyz", self.position.min(axis=0), self.position.max(axis=0), strict=True)
                box = ", ".join(f"{axis} from {low:.6g} to {high:.6g}" for axis, low, high in ends)
                raise ConfigError(f"{key}: no node of {self.name} lies in {place.text!r}; it reaches in {box}")
            nodes |= inside
        return nodes

    def _known(self, kind: str, name: str, key: str) -> np.ndarray:
        known = self.fields if kind == "field" else self.groups
        if name not in known:
            raise ConfigError(f"{key}: {self.name} has no {kind} {name!r}{nearest_name(name, known)}")
        return known[name]


def part_meshes(spec: AssemblySpec, values: Values, factor: float = 1.0, halved: bool = False) -> list[PartMesh]:
    """The meshes of all parts for these values of the parameters.

    Args:
        factor: all element sizes are multiplied by this.
        halved: the elements of mesh files, but for rigid parts, are cut into eight each.

    Raises:
        BadMesh, MeshingFailed: a part cannot be meshed, or its mesh cannot be used; the text names it.
        DatasetError, ConfigError: a mesh file cannot be read, or a size is not above 0.
        MissingExtra: a part needs gmsh, which is not installed.
    """
    requests = [_request(spec, part, values, factor, halved) for part in spec.parts]
    keys = [json.dumps(request, sort_keys=True) for request in requests]
    new = {key: place for place, key in enumerate(keys) if key not in _kept}
    cad = [place for place in new.values() if "size" in requests[place]]
    if cad and gmsh_version() is None:
        name = requests[cad[0]]["name"]
        raise MissingExtra(f'gmsh is needed to mesh {name} but is not installed: pip install "ast_sim[cad]"')
    for place in cad:
        if "stl" in requests[place] and not spec.parts[place].rigid:
            surface = _stl(requests[place])
            check_surface(surface.position, surface.triangles, requests[place]["name"])
    sent = [{key: v for key, v in requests[place].items() if key not in ("scale", "stamp")} for place in cad]
    meshed = dict(zip(cad, mesh_own_scale(sent) if sent else [], strict=True))
    kept = {key: _kept[key] for key in keys if key in _kept}
    for key, place in new.items():
        arrays = meshed.get(place)
        part = spec.parts[place]
        kept[key] = _from_file(part, requests[place]) if arrays is None else _meshed(part, requests[place], arrays)
    _kept.update(kept)
    while len(_kept) > MESHES_KEPT:
        del _kept[next(iter(_kept))]
    return [kept[key] for key in keys]


def _request(spec: AssemblySpec, part: PartSpec, values: Values, factor: float, halved: bool) -> dict[str, Any]:
    """All that the mesh of a part depends on; with "size", it is a request to gmsh."""
    file = part.files[0] if len(part.files) == 1 else str(values[f"{part.name}.file"])
    path = spec.file(file)
    changed = path.stat()
    kind = path.suffix.lower()
    scale = part.scale * (MILLIMETRE / LENGTH_UNITS[spec.unit] if kind in IGES_ENDINGS else 1.0)
    request: dict[str, Any] = {
        "name": f"{part.name} ({file})",
        "scale": scale,
        "surface": part.rigid,
        "order": spec.order,
    }
    request["stamp"] = [str(path), changed.st_mtime_ns, changed.st_size]
    if part.solid is not None:
        request["solid"] = part.solid
    if part.size is None:
        return request | {"halved": halved and not part.rigid}
    size = factor * part.size(values) / scale
    finer = []
    for one in part.finer:
        box = [corner(values) / scale for corner in (*one.low, *one.high)]
        finer.append({"box": box, "size": factor * one.size(values) / scale})
    if min([size, *(one["size"] for one in finer)]) <= 0:
        raise ConfigError(f"parts.{part.name}.size: the length of an element must be above 0")
    request |= {"size": size, "finer": finer}
    if kind in CAD_ENDINGS:
        return request | {"step": str(path)} | ({"unit": UNITS[spec.unit]} if kind in STEP_ENDINGS else {})
    if kind == STL_ENDING:
        return request | {"stl": str(path)}
    assert kind in SCRIPT_ENDINGS
    request["arguments"] = {name: one(values) for name, one in part.arguments.items()}
    if kind == ".py":
        return request | {"script": str(path), "function": script_and_function(file)[1]}
    return request | {"geo": str(path)}


def _stl(request: dict[str, Any]) -> TriangleSurface:
    """The surface of an STL file, or of the one of its solids that is named.

    Raises:
        BadMesh: there is no such surface; the text names the part.
    """
    try:
        return stl_surface(Path(request["stamp"][0]), request.get("solid"), whole=request["surface"])
    except BadSurface as error:
        raise BadMesh(f"{request['name']}: {error}") from error


def _meshed(part: PartSpec, request: dict[str, Any], arrays: dict[str, np.ndarray]) -> PartMesh:
    """What gmsh has meshed."""
    groups = {key.removeprefix("group "): nodes for key, nodes in arrays.items() if key.startswith("group ")}
    position = request["scale"] * arrays["position"]
    cells = arrays["elements"]
    notes = [f"{request['name']}: {note}" for note in arrays["notes"]]
    if arrays["factor"] != 1:
        size = request["scale"] * request["size"]
        taken = f"elements of the size {arrays['factor'] * size:.4g} instead of {size:.4g}"
        notes.append(f"{request['name']}: {taken}, with which Gmsh gives no good mesh ({arrays['failure']})")
    return _checked(PartMesh(request["name"], position, cells, groups, notes=tuple(notes)), part.rigid)


def _from_file(part: PartSpec, request: dict[str, Any]) -> PartMesh:
    """A mesh, or a rigid surface, as it stands in its file."""
    if Path(request["stamp"][0]).suffix.lower() == STL_ENDING:
        return _surface_mesh(part, request, _stl(request))
    mesh = read_mesh(Path(request["stamp"][0]), corners=request["order"] == 1)
    used, elements = np.unique(mesh.elements, return_inverse=True)
    elements = elements.reshape(-1, mesh.elements.shape[1])
    position = request["scale"] * mesh.points[used]
    told = ("; ".join(mesh.notes),) if mesh.notes else ()
    notes = tuple(f"{request['name']}: {note}" for note in told)
    fields = {
        n: np.asarray(v)[used] for n, v in mesh.fields["point"].items() if np.ndim(v) == 1 and v.dtype.kind in "iufb"
    }
    groups = {name: np.flatnonzero(np.isin(used, nodes)) for name, nodes in mesh.groups.items()}
    if elements.shape[1] == 3:
        if not np.isfinite(position).all():
            raise BadMesh(f"{request['name']}: a corner is not finite")
        surface = whole_surface(mesh.points[used][elements])
        return _surface_mesh(part, request, replace(surface, notes=(*told, *surface.notes)))
    mesh = PartMesh(request["name"], position, elements, groups, fields, notes)
    mesh = _raised(mesh) if request["order"] == 2 and elements.shape[1] == 4 else mesh
    mesh = _halved(mesh) if request["halved"] else mesh
    return _with_note_of_edges(_checked(mesh, part.rigid), mesh)


def _with_note_of_edges(checked: PartMesh, mesh: PartMesh) -> PartMesh:
    """The checked mesh of a file, with a note if edges of it have become straight."""
    changed = int((checked.position != mesh.position).any(axis=1)[checked.cells].any(axis=1).sum())
    if not changed:
        return checked
    get = f"{mesh.name}: {counted(changed, 'element gets', 'elements get')} straight edges"
    return replace(checked, notes=(*checked.notes, f"{get}: as in the file they would turn a part of an element over"))


def _halved(mesh: PartMesh) -> PartMesh:
    """The same body in elements half as long: each is cut into eight."""
    second = mesh.cells.shape[1] == 10
    raised = mesh if second else _raised(mesh)
    cut = replace(raised, cells=linear_elements(raised.cells))
    return _raised(cut) if second else cut


def _raised(mesh: PartMesh) -> PartMesh:
    """The same tetrahedra with nodes in the middles of their edges. A middle is in a group, or marked, if both its ends
    are."""
    position, cells = second_order(mesh.position, mesh.cells)
    ends = np.zeros((len(position) - len(mesh.position), 2), int)
    ends[cells[:, 4:] - len(mesh.position)] = cells[:, np.array(MIDDLES)]

    def of_nodes(values: np.ndarray) -> np.ndarray:
        first, second = values[ends].T
        return np.concatenate([values, np.where((first != 0) & (second != 0), first, 0)])

    inside = {name: np.isin(np.arange(len(mesh.position)), nodes) for name, nodes in mesh.groups.items()}
    groups = {name: np.flatnonzero(of_nodes(nodes)) for name, nodes in inside.items()}
    return PartMesh(
        mesh.name,
        position,
        cells,
        groups,
        {name: of_nodes(values) for name, values in mesh.fields.items()},
        mesh.notes,
    )


def _surface_mesh(part: PartSpec, request: dict[str, Any], surface: TriangleSurface) -> PartMesh:
    notes = tuple(f"{request['name']}: {note}" for note in surface.notes)
    mesh = PartMesh(request["name"], request["scale"] * surface.position, surface.triangles, notes=notes)
    return _checked(mesh, part.rigid)


def _checked(mesh: PartMesh, rigid: bool) -> PartMesh:
    """The mesh after all checks, its tetrahedra of positive volume.

    Raises:
        BadMesh: it cannot be used.
    """
    position = mesh.position
    cells = mesh.cells
    if cells.shape[1] == 3:
        if not rigid:
            raise BadMesh(
                f"{mesh.name}: it holds triangles; a part that deforms needs tetrahedra, or a size to mesh it"
            )
        check_no_intersections(position, cells, mesh.name)
        return mesh
    if np.isfinite(position).all():
        if (volumes(position, cells) < 0).all():
            cells = oriented(position, cells)
        position = straightened(position, cells) if cells.shape[1] == 10 else position
    check_mesh(position, cells, mesh.name, SMALLEST_ANGLE)
    return PartMesh(mesh.name, position, cells, mesh.groups, mesh.fields, mesh.notes)
