"""A scene from a mesh: the bodies, the prescribed nodes and the material."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.importers.mesh_file import MeshFile, read_mesh
from ast_sim.importers.places import Place, parse_places
from ast_sim.scene import NodeType, Scene, nodes_of_body
from ast_sim.support.errors import ConfigError, DatasetError

if TYPE_CHECKING:
    import meshio

# A tetrahedron (triangle) is flat if its volume (area) is below this share of its longest edge to the power of 3 (2).
_FLAT = 1e-6

Numbers = float | Sequence[float]


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """A scene, and `notes`: sentences that say how it differs from the mesh."""

    scene: Scene
    notes: list[str]

    @property
    def description(self) -> list[str]:
        """Lines of text, with which a person can check the scene: the scene, each body, the notes."""
        return describe(self.scene) + self.notes


def read_scene(
    source: Path | str | meshio.Mesh,
    *,
    obstacles: Iterable[int] = (),
    clamps: Iterable[str] = (),
    body_field: str | None = None,
    type_field: str | None = None,
    materials: Mapping[int, Numbers] | Numbers | None = None,
    material_fields: Sequence[str] = (),
) -> SceneMesh:
    """The scene of a mesh: a file that meshio reads, or a mesh in memory.

    The elements are the tetrahedra; the triangles if there are no three-dimensional cells. Triangles and quadrilaterals
    beside tetrahedra that touch none are rigid shells: they become obstacles, thin layers of tetrahedra whose front is
    the shell. Points that belong to no element are left out. Tetrahedra that are inside out are turned over.

    Args:
        obstacles: numbers of the bodies that are rigid and move as prescribed.
        clamps: nodes of deforming bodies that move as prescribed; each text as in `parse_clamp`.
        body_field: point or cell field with the numbers of the bodies. None: "body" if it is present; else each
            connected part of the mesh is a body, numbered from 0 in the order of their lowest nodes.
        type_field: point field with the numbers of `NodeType`. None: "node_type" if it is present; else all nodes are
            free. `clamps` and then `obstacles` change these types.
        materials: the material of each body by its number, or one material for all bodies. A body whose nodes are all
            obstacles has zeros if it is not named.
        material_fields: instead of `materials`, cell fields with one number each.

    Raises:
        DatasetError: the file cannot be read, or a node, an element or a field is wrong; the text names the file.
        ConfigError: there is no such body, a place holds no node, a material is missing, or nothing is prescribed.
    """
    mesh = read_mesh(Path(source) if isinstance(source, str) else source, curved=True)
    scene, used = mesh.scene(body_field, type_field)
    scene.check(str(mesh.path))
    scene, turned = _turned_over(scene, mesh.path)
    scene = replace(scene, node_type=_node_type(mesh, scene, used, obstacles, clamps))
    scene = replace(scene, material=_material(mesh, scene, materials, material_fields))
    if not scene.prescribed.any():
        raise ConfigError(
            f"{mesh.path}: nothing is prescribed: mark a body with --obstacle BODY or nodes with --clamp BODY:PLACE,"
            " for example --clamp 0:xmin"
        )
    scene.check(str(mesh.path))
    unused = len(mesh.points) - len(used)
    notes = [*mesh.notes]
    notes += [f"{unused} points of no element are left out"] if unused else []
    notes += [f"{turned} tetrahedra that were inside out are turned over"] if turned else []
    return SceneMesh(scene, notes)


def describe(scene: Scene) -> list[str]:
    """A line on the scene, and one on each body: its nodes by type, its elements, its bounding box."""
    kind = "triangles" if scene.elements.shape[1] == 3 else "tetrahedra"
    body_of_element = scene.body[scene.elements[:, 0]]
    lines = [f"{len(np.unique(scene.body))} bodies, {scene.num_nodes} nodes, {scene.num_elements} {kind}"]
    for body in np.unique(scene.body):
        nodes = scene.body == body
        counts = {t.name.lower(): int((scene.node_type[nodes] == t).sum()) for t in NodeType}
        types = ", ".join(f"{count} {name}" for name, count in counts.items() if count)
        points = scene.rest_position[nodes]
        box = zip("xyz", points.min(axis=0), points.max(axis=0), strict=True)
        extent = ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in box)
        lines.append(f"body {body}: {nodes.sum()} nodes ({types}), {(body_of_element == body).sum()} {kind}, {extent}")
    return lines


def parse_clamp(text: str) -> tuple[int, list[Place]]:
    """The body and the places of `BODY:PLACE[,PLACE...]`; the nodes of the body in any of these places are clamped.

    PLACE is `all`, `xmin`, `z<=0.01`, `0<x<2 and 0<y<1`, `field=NAME`, `group=NAME` and the like: see
    `ast_sim.importers.places`.

    Raises:
        ConfigError: the text has another form; the error gives examples.
    """
    try:
        body, places = text.split(":", 1)
        return int(body), parse_places(places)
    except ValueError as error:
        raise ConfigError(
            f"the clamp {text!r} cannot be read; write BODY:PLACE, for example 0:xmin, 0:xmin,xmax, 0:z<=0.01, 0:all,"
            " 0:0<x<2 and 0<y<1, 0:field=NAME or 0:group=NAME"
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


def _turned_over(scene: Scene, path: Path) -> tuple[Scene, int]:
    """The scene with all tetrahedra of negative volume turned over, and the number of these tetrahedra."""
    corners = scene.rest_position[scene.elements].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    longest = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=-1).max(axis=(1, 2))
    if edges.shape[1] == 3:
        size, kind = np.linalg.det(edges) / 6, "volume"
    else:
        size, kind = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / 2, "area"
    flat = np.abs(size) <= _FLAT * longest ** edges.shape[1]
    if flat.any():
        row = int(np.argmax(flat))
        raise DatasetError(
            f"{path}: element {row} with the nodes {scene.elements[row].tolist()} has no {kind}; {flat.sum()} of"
            f" {len(flat)} elements have none: repair the mesh"
        )
    elements = scene.elements.copy()
    elements[size < 0, -2:] = elements[size < 0, :-3:-1]
    return replace(scene, elements=elements), int((size < 0).sum())


def _node_type(
    mesh: MeshFile, scene: Scene, used: np.ndarray, obstacles: Iterable[int], clamps: Iterable[str]
) -> np.ndarray:
    types = scene.node_type.copy()
    for clamp in clamps:
        body, places = parse_clamp(clamp)
        nodes = np.flatnonzero(nodes_of_body(scene.body, body))
        for place in places:
            inside = place.inside(mesh.points[used[nodes]], *mesh.masks(used[nodes]))
            if not inside.any():
                low, high = (scene.rest_position[nodes].min(axis=0), scene.rest_position[nodes].max(axis=0))
                raise ConfigError(
                    f"no node of body {body} lies in {place.text!r}; it reaches from {low.tolist()} to {high.tolist()}"
                )
            types[nodes[inside]] = NodeType.HANDLE
    for body in obstacles:
        types[nodes_of_body(scene.body, body)] = NodeType.OBSTACLE
    return types


def _material(
    mesh: MeshFile, scene: Scene, materials: Mapping[int, Numbers] | Numbers | None, fields: Sequence[str]
) -> np.ndarray | None:
    """[E, m] float32; None if no material is given."""
    if materials is None:
        return mesh.columns(fields)
    if fields:
        raise ConfigError("the material is given twice: by body and by cell fields; leave one out")
    bodies = [int(body) for body in np.unique(scene.body)]
    deforming = [b for b in bodies if (scene.node_type[scene.body == b] != NodeType.OBSTACLE).any()]
    given = materials if isinstance(materials, Mapping) else dict.fromkeys(deforming, materials)
    rows = {body: np.atleast_1d(np.asarray(numbers, np.float32)) for body, numbers in given.items()}
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
