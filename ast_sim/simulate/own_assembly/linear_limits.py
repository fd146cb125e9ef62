"""Where linear tetrahedra are far too stiff: in walls that bend with few of them across, and in rubber.

Legend: N nodes, F triangles of the surface of a part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from ast_sim.element_topology import LOCAL_EDGES, unit_normals
from ast_sim.mechanics.case import SolidCase
from ast_sim.number_arrays import connected_parts, point
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec
from ast_sim.simulate.own_assembly.rest_check import surface_of
from ast_sim.support.errors import counted

ENOUGH = 3  # elements across a wall that bends
LARGEST_POISSON = 0.45
OPPOSITE = -0.9  # cosine between the normals of the two sides of a wall, at most
SLENDER = 4  # a wall bends if its length is at least this multiple of its thickness
INWARD = 1e-6  # rays start that far inside, as a share of the size of the part
CURE = "leave out order = 1"


@dataclass(frozen=True)
class Limit:
    """What is wrong with a part.

    Attributes:
        part: its name.
        kind: "thin" or "rubber".
        badness: the larger, the worse, among limits of one kind.
        text: a sentence.
    """

    part: str
    kind: str
    badness: float
    text: str


def limits(spec: AssemblySpec, case: SolidCase) -> Iterator[Limit]:
    """What linear elements get wrong in a drawn scene; nothing for other elements."""
    if case.scene.elements.shape[1] != 4:
        return
    poisson = np.broadcast_to(case.material.poisson, case.scene.num_elements)
    for number, part in enumerate(spec.parts):
        elements = case.scene.body[case.scene.elements[:, 0]] == number
        if part.rigid:
            continue
        ratio = float(poisson[elements].max())
        if ratio > LARGEST_POISSON:
            text = (
                f"{part.name}: its {counted(elements.sum(), 'linear element locks', 'linear elements lock')} at"
                f" Poisson's ratio {ratio:.4g}, above {LARGEST_POISSON}, and its forces are too large: {CURE}"
            )
            yield Limit(part.name, "rubber", ratio, text)
        yield from _thin(spec, case, number)


def _thin(spec: AssemblySpec, case: SolidCase, number: int) -> Iterator[Limit]:
    """The wall of a part that has too few elements across, if it is long enough to bend."""
    rest = case.scene.rest_position.astype(np.float64)
    faces = surface_of(case, number)
    middle, thickness, other = _across(rest, faces)
    held = np.all(case.scene.prescribed[faces], axis=1)
    wall = np.flatnonzero((other >= 0) & ~held & ~held[other])
    few = wall[_elements_across(case, number, faces[wall], faces[other[wall]]) < ENOUGH]
    few = few[_can_bend(faces[few], middle[few], thickness[few])]
    if not len(few):
        return
    first = few[np.argmin(thickness[few])]
    where = point(middle[first] + np.asarray(case.attributes["origin"]))
    text = (
        f"{spec.parts[number].name}: fewer than {ENOUGH} linear elements lie across its wall at {len(few)} of"
        f" {counted(len(faces), 'triangle')} of its surface, such as {where}, where it is {thickness[first]:.3g}"
        f" {spec.unit} thick. If it bends there, it is several times too stiff: {CURE}, or choose a smaller size"
    )
    yield Limit(spec.parts[number].name, "thin", len(few) / len(faces), text)


def _can_bend(faces: np.ndarray, middle: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """[F] bool: which triangles are of a wall that is long enough. Triangles of a wall share nodes: small knobs that
    stand apart are none."""
    nodes, corners = np.unique(faces, return_inverse=True)
    rows = corners.reshape(faces.shape)
    wall = connected_parts(rows, len(nodes))[rows[:, 0]]
    low = np.full((wall.max(initial=0) + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, wall, middle)
    np.maximum.at(high, wall, middle)
    mean = np.bincount(wall, thickness) / np.bincount(wall)
    return (np.linalg.norm(high - low, axis=1) >= SLENDER * mean)[wall]


def _across(rest: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The middles [F,3] of triangles, the thickness [F] of the wall behind each, and the triangle [F] on its other
    side; -1 where the other side is not about parallel."""
    import igl  # takes 0.2 s

    corners = rest[faces]
    normal = unit_normals(corners)
    middle = corners.mean(axis=1)
    inward = INWARD * np.linalg.norm(np.ptp(corners, axis=(0, 1)))
    tree = igl.AABB()
    rows = faces.astype(np.int64)
    tree.init(rest, rows)
    hit, distance = map(np.asarray, tree.intersect_ray_first(rest, rows, middle - inward * normal, -normal)[:2])
    parallel = np.einsum("fi,fi->f", normal, normal[hit]) <= OPPOSITE
    return middle, distance, np.where((hit >= 0) & parallel, hit, -1)


def _elements_across(case: SolidCase, number: int, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """[n]: on how many edges of elements one gets from each triangle [n,3] to the one on the other side; at most
    `ENOUGH`."""
    elements = case.scene.elements[case.scene.body[case.scene.elements[:, 0]] == number]
    edges = elements[:, np.array(LOCAL_EDGES[4])].reshape(-1, 2)
    count = case.scene.num_nodes
    neighbours = coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(count, count)).tocsr()
    neighbours = neighbours + neighbours.T
    reached, target = _marked(near, count), _marked(far, count)
    across = np.full(len(near), ENOUGH)
    for steps in range(ENOUGH):
        across[(across == ENOUGH) & (reached.multiply(target).sum(axis=1) > 0)] = steps
        reached = reached @ neighbours
    return across


def _marked(triangles: np.ndarray, count: int) -> csr_array:
    """[n,N] sparse: 1 for the corners of each triangle."""
    rows = np.repeat(np.arange(len(triangles)), 3)
    return coo_array((np.ones(triangles.size), (rows, triangles.ravel())), shape=(len(triangles), count)).tocsr()
