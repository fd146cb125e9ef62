"""A scene from a mesh: the bodies, the prescribed nodes and the material."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.element_topology import shortest_edge
from ast_sim.importers.mesh_file import MeshFile, read_mesh
from ast_sim.importers.places import Place, parse_places
from ast_sim.material import Material
from ast_sim.mesh_arrays import of_obstacles
from ast_sim.mesh_rules import require_extent
from ast_sim.number_arrays import nodes_of_body, real_numbers, rounding
from ast_sim.plausibility.topology import at_rest
from ast_sim.scene import NodeType, Scene
from ast_sim.support.argument_checks import file_name, in_short, require_bool, require_type, several
from ast_sim.support.errors import ConfigError, DatasetError, counted

if TYPE_CHECKING:
    import meshio

# Nodes lie on a line if their second extent, as a share of the first, is below this.
_ON_A_LINE = 1e-3

Numbers = float | Sequence[float]


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """A scene; `notes`: sentences that say how it differs from the mesh; `warnings`: what looks wrong in it."""

    scene: Scene
    notes: list[str]
    warnings: list[str]

    @property
    def description(self) -> list[str]:
        """Lines of text, with which a person can check the scene: the scene, each body, the notes, the warnings."""
        return [*describe(self.scene), *self.notes, *(f"warning: {text}" for text in self.warnings)]


def read_scene(
    source: Path | str | meshio.Mesh,
    *,
    obstacles: Iterable[int] = (),
    clamps: Iterable[str] = (),
    body_field: str | None = None,
    type_field: str | None = None,
    materials: Mapping[int, Numbers] | Numbers | None = None,
    material_fields: Sequence[str] = (),
    corners: bool = False,
) -> SceneMesh:
    """The scene of a mesh: a file of any known format, or a mesh in memory.

    The elements are the tetrahedra; hexahedra, prisms and pyramids are cut into them. If there is none of all these,
    the elements are the triangles, and quadrilaterals are cut into them. Triangles and quadrilaterals beside tetrahedra
    that touch none are rigid shells: they become obstacles, thin layers of tetrahedra whose front is the shell. Points
    that belong to no element are left out. Tetrahedra that are inside out are turned over, and points that stand
    several times are joined.

    Args:
        obstacles: numbers of the bodies that are rigid and move as prescribed.
        clamps: nodes of deforming bodies that move as prescribed; each text as in `parse_clamp`.
        body_field: point or cell field with the numbers of the bodies. None: "body" if it is present; else each
            connected part of the mesh is a body, numbered from 0 in the order of their lowest nodes.
        type_field: point field with the numbers of `NodeType`. None: "node_type" if it is present; else all nodes are
            free. `clamps` and `obstacles` change these types; a body with both is an obstacle, and
            a warning says so.
        materials: the material of each body by its number, or one material for all bodies. A body whose nodes are all
            obstacles has zeros if it is not named.
        material_fields: instead of `materials`, cell fields with one number each.
        corners: take only the corners of second-order tetrahedra.

    Raises:
        DatasetError: the file cannot be read, or a node, an element or a field is wrong; the text names the file.
        ConfigError: there is no such body, a place holds no node, a material is missing, or nothing is prescribed.
    """
    require_bool(corners=corners)
    if isinstance(source, str | Path):
        source = file_name(source, "source")
    elif not hasattr(source, "cells"):
        raise ConfigError(f"source is {in_short(source)}; it must be the name of a file or a mesh of meshio")
    used_fields = (type_field or "node_type", body_field or "body")
    mesh = read_mesh(source, used_fields=used_fields, corners=corners)
    scene, used = mesh.scene(body_field, type_field)
    scene.check(str(mesh.path))
    require_extent(str(mesh.path), mesh.points[used], scene.elements)
    types, doubts = _node_type(mesh, scene, used, obstacles, clamps)
    scene = replace(scene, node_type=types)
    scene = replace(scene, material=_material(mesh, scene, materials, material_fields))
    if not scene.prescribed.any():
        raise ConfigError(
            f"{mesh.path}: nothing is prescribed: mark a body with obstacles=[BODY] (--obstacle BODY) or nodes with"
            " clamps=['BODY:PLACE'] (--clamp BODY:PLACE), for example 0:xmin"
        )
    scene.check(str(mesh.path))
    if mesh.reduced:
        doubts.append("elements keep their corners only: they are stiffer, so no force of theirs is right")
    doubts += rounding(mesh.points[used], scene.rest_position, scene.elements)
    return SceneMesh(scene, [*mesh.notes], [*doubts, *map(str, at_rest(scene))])


def describe(scene: Scene) -> list[str]:
    """A line on the scene, and one on each body: its nodes by type, its elements, its bounding box."""
    kind, kinds = {
        3: ("triangle", "triangles"),
        4: ("tetrahedron", "tetrahedra"),
        10: ("second-order tetrahedron", "second-order tetrahedra"),
    }[scene.elements.shape[1]]
    body_of_element = scene.body[scene.elements[:, 0]]
    lines = [
        f"{counted(len(np.unique(scene.body)), 'body', 'bodies')}, {counted(scene.num_nodes, 'node')},"
        f" {counted(scene.num_elements, kind, kinds)}"
    ]
    for body in np.unique(scene.body):
        nodes = scene.body == body
        counts = {t.name.lower(): int((scene.node_type[nodes] == t).sum()) for t in NodeType}
        types = ", ".join(f"{count:,} {name}" for name, count in counts.items() if count)
        points = scene.rest_position[nodes]
        box = zip("xyz", points.min(axis=0), points.max(axis=0), strict=True)
        extent = ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in box)
        elements = counted((body_of_element == body).sum(), kind, kinds)
        lines.append(f"body {body}: {counted(nodes.sum(), 'node')} ({types}), {elements}, {extent}")
    return lines


def parse_clamp(text: str, known: Iterable[str] = ()) -> tuple[int, list[Place]]:
    """The body and the places of `BODY:PLACE[,PLACE...]`; the nodes of the body in any of these places are clamped.

    PLACE is `all`, `xmin`, `z<=0.01`, `0<x<2 and 0<y<1`, `field=NAME`, `group=NAME` and the like: see
    `ast_sim.importers.places`. `known` are names of fields and groups, which may hold commas and the word "and".

    Raises:
        ConfigError: the text has another form; the error gives examples.
    """
    try:
        body, places = text.split(":", 1)
        return int(body), parse_places(places, known)
    except ValueError as error:
        raise ConfigError(
            f"the clamp {text!r} cannot be read; write BODY:PLACE, for example 0:xmin, 0:xmin,xmax, 0:z<=0.01, 0:all,"
            ' 0:0<x<2 and 0<y<1, 0:field=NAME, 0:group=NAME or 0:group="A, B and C"'
        ) from error


def parse_material(text: str) -> tuple[int, tuple[float, ...]]:
    """The body and the numbers of `BODY=NUMBER[,NUMBER...]`.

    Raises:
        ConfigError: the text has another form; the error gives an example.
    """
    try:
        body, numbers = text.split("=", 1)
        return int(body), tuple(float(number) for number in numbers.split(","))
    except ValueError as error:
        raise ConfigError(f"the material {text!r} cannot be read; write BODY=NUMBERS, for example 0=2e5,0.3") from error


def _node_type(
    mesh: MeshFile, scene: Scene, used: np.ndarray, obstacles: Iterable[int], clamps: Iterable[str]
) -> tuple[np.ndarray, list[str]]:
    """The types of the nodes, and warnings of clamps that hold nodes on a line only."""
    types = scene.node_type.copy()
    doubts = []
    rigid = [
        nodes_of_body(scene.body, body) for body in several("obstacles", obstacles, "numbers of bodies, such as [1]")
    ]
    of_arguments = np.where(np.any(rigid, axis=0), NodeType.OBSTACLE, NodeType.NORMAL) if rigid else 0 * types
    for clamp in several("clamps", clamps, "texts, such as ['0:xmin']"):
        require_type("a clamp", clamp, str, "a text, such as '0:xmin'")
        held = clamped(mesh, scene, used, clamp)
        doubts += of_obstacles(f"the clamp {clamp!r}", held, of_arguments, scene.body)
        types[held] = NodeType.HANDLE
        if scene.elements.shape[1] != 3 and _on_a_line(mesh.points[used[held]]):
            body = scene.body[held[0]]
            doubts.append(
                f"the clamp {clamp!r} holds {counted(len(held), 'node')}, on one line, around which body {body} could"
                " turn"
            )
    for nodes in rigid:
        types[nodes] = NodeType.OBSTACLE
    return types, doubts


def clamped(mesh: MeshFile, scene: Scene, used: np.ndarray, clamp: str) -> np.ndarray:
    """[k] the nodes of the scene of a mesh that a clamp holds; the node i is the point `used[i]` of the mesh.

    Raises:
        ConfigError: the clamp cannot be read, there is no such body, or no node lies there.
        DatasetError: there is no such field or group.
    """
    body, places = parse_clamp(clamp, [*mesh.groups, *mesh.source.point_fields])
    nodes = np.flatnonzero(nodes_of_body(scene.body, body))
    shortest = shortest_edge(scene.rest_position, scene.elements[scene.body[scene.elements[:, 0]] == body])
    held = np.zeros(len(nodes), bool)
    for place in places:
        inside = place.inside(mesh.points[used[nodes]], *mesh.masks(used[nodes]), shortest)
        if not inside.any():
            low, high = (mesh.points[used[nodes]].min(axis=0), mesh.points[used[nodes]].max(axis=0))
            raise ConfigError(
                f"no node of body {body} lies in {place.text!r}; it reaches from {low.tolist()} to {high.tolist()}"
            )
        held |= inside
    return nodes[held]


def marked_nodes(mesh: MeshFile, scene: Scene, used: np.ndarray, name: str) -> np.ndarray:
    """The nodes of the scene of a mesh that a point field, a group or a place BODY:PLACE marks, as a mask or as
    numbers; `used` as in `clamped`. A note tells if a field and a group have the name.

    Raises:
        DatasetError, ConfigError: there is none of this name; see `clamped`.
    """
    if name in mesh.source.point_fields:
        marks = mesh.marks(name)[used]
        if name in mesh.groups and not np.array_equal(marks, np.isin(used, mesh.groups[name])):
            mesh.notes.append(f"{name!r} is a field of points and a group of other nodes: the field is taken")
        return marks
    if name in mesh.groups:
        return np.isin(used, mesh.groups[name])
    if re.match(r"\s*[0-9]+\s*:", name):
        return clamped(mesh, scene, used, name)
    fields = ", ".join(sorted(mesh.source.point_fields)) or "none"
    groups = ", ".join(sorted(mesh.groups)) or "none"
    raise DatasetError(
        f"{mesh.path}: there is no point field {name!r}; there are: {fields}; groups of nodes: {groups}; places are"
        " written BODY:PLACE, for example 0:zmin"
    )


def _on_a_line(points: np.ndarray) -> bool:
    if len(points) < 3:
        return True
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] <= _ON_A_LINE * extents[0])


def _material(
    mesh: MeshFile, scene: Scene, materials: Mapping[int, Numbers] | Numbers | None, fields: Sequence[str]
) -> np.ndarray | None:
    """[E, m] float32; None if no material is given."""
    if materials is None:
        columns = mesh.columns(fields)
        Material(tuple(fields)).require_possible(str(mesh.path), columns, ~scene.rigid_elements)
        return columns
    if fields:
        raise ConfigError("the material is given twice: by body and by cell fields; leave one out")
    bodies = [int(body) for body in np.unique(scene.body)]
    rigid = scene.rigid_bodies
    deforming = [body for body in bodies if body not in rigid]
    given = materials if isinstance(materials, Mapping) else dict.fromkeys(deforming, materials)
    for body, one in given.items():
        if isinstance(one, Mapping):
            raise ConfigError(
                f"the material of body {body} is {in_short(one)}; it must be a number or numbers, in the order of the"
                " columns of the training, such as (2e5, 0.3)"
            )
    numbers = {body: real_numbers(str(mesh.path), "materials", one) for body, one in given.items()}
    rows = {body: np.atleast_1d(one) for body, one in numbers.items()}
    for body in rows:
        nodes_of_body(scene.body, body)
    missing = [body for body in deforming if body not in rows]
    if missing:
        raise ConfigError(
            f"body {missing[0]} has no material; give one for each of the bodies that deform: {deforming}"
        )
    counts = {body: row.size for body, row in rows.items()}
    if len(set(counts.values())) > 1:
        raise ConfigError(f"the bodies have different numbers of material parameters: {counts}")
    columns = next(iter(counts.values()), 0)
    table = np.stack([rows.get(body, np.zeros(columns, np.float32)) for body in bodies])
    return table[np.searchsorted(bodies, scene.body[scene.elements[:, 0]])]
