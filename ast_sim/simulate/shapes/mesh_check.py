"""What is wrong with a tetrahedral mesh or a closed surface, and where, in one line.

Legend: N nodes, E tetrahedra, F triangles; lengths in the units of the part.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ast_sim.element_topology import FACE_TRIANGLES, LOCAL_FACES, equal_rows, folded_elements, triangle_sides
from ast_sim.mechanics.contact_and_friction import load_ipctk
from ast_sim.number_arrays import connected_parts, point
from ast_sim.simulate.shapes.cad.surface_mend import TriangleSurface, solids_of
from ast_sim.simulate.shapes.parts import smallest_dihedral, volumes
from ast_sim.support.errors import SimulationError, counted

SMALLEST_ANGLE = 5.0  # degrees between two faces of a tetrahedron
SMALLEST_VOLUME = 1e-6  # smallest volume of a part, relative to the cube of its diagonal
SAME_PLACE = 1e-9  # distance of two nodes, relative to the diagonal
MOST_NODES = 200_000  # largest number of nodes of one part


class BadMesh(SimulationError):
    """A mesh or surface that cannot be a part of a scene."""


def check_mesh(position: np.ndarray, elements: np.ndarray, name: str, smallest_angle: float = SMALLEST_ANGLE) -> None:
    """Check a solid body, positions [N,3] and tetrahedra [E,4] or [E,10].

    Raises:
        BadMesh: the text names the part, what is wrong and where: no tetrahedra, too many nodes, numbers that are not
            finite, two nodes at one place, elements that are inverted, flat, lie on others or have a dihedral angle
            below `smallest_angle` degrees, no volume, several pieces, or a surface that cuts itself. Angles and volumes
            are measured between the corners.
    """
    if len(elements) == 0:
        raise BadMesh(f"{name}: it holds no tetrahedra")
    if len(position) > MOST_NODES:
        raise BadMesh(f"{name}: it has {len(position):,} nodes, more than the {MOST_NODES:,} of the largest part")
    _check_points(position, name, "nodes")
    diagonal = _diagonal(position)
    volume = volumes(position, elements)
    centre = position[elements].mean(axis=1)
    flat = np.abs(volume) <= 1e-12 * diagonal**3
    if flat.any():
        first = int(np.argmax(flat))
        raise BadMesh(
            f"{name}: {_count(flat, 'tetrahedron', 'tetrahedra')} of zero volume: {_at(first, elements, centre)}"
        )
    inverted = volume < 0
    if inverted.any():
        first = int(np.argmax(inverted))
        raise BadMesh(
            f"{name}: {_count(inverted, 'inverted tetrahedron', 'inverted tetrahedra')}: {_at(first, elements, centre)}"
        )
    folded = folded_elements(elements, inverted)
    if len(folded):
        raise BadMesh(
            f"{name}: {counted(len(folded), 'tetrahedron', 'tetrahedra')} in a fold of the mesh, which lie on others:"
            f" {_at(folded[0], elements, centre)}; mesh it again"
        )
    _check_volume(volume.sum(), diagonal, name)
    _check_pieces(_element_pieces(elements), centre, name, "not joined by a common face")
    angle = smallest_dihedral(position, elements)
    sharp = angle < smallest_angle
    if sharp.any():
        first = int(np.argmin(angle))
        raise BadMesh(
            f"{name}: {_count(sharp, 'tetrahedron', 'tetrahedra')} with a dihedral angle below {smallest_angle:g}"
            f" degrees, the sharpest with {angle[first]:.2g}: {_at(first, elements, centre)}; mesh it again"
        )
    check_no_intersections(position, boundary(elements), name)


def check_surface(position: np.ndarray, triangles: np.ndarray, name: str) -> None:
    """Check a closed surface, positions [N,3] and triangles [F,3] that share their nodes.

    Raises:
        BadMesh: the text names the part, what is wrong and where: no triangles, numbers that are not finite, edges of
            one triangle or of more than two, several solids, no volume, or triangles that cut one another.
    """
    if len(triangles) == 0:
        raise BadMesh(f"{name}: it holds no triangles")
    finite = np.isfinite(position).all(axis=1)
    if not finite.all():
        raise BadMesh(f"{name}: a corner is not finite: {point(position[np.argmin(finite)])}")
    edges, uses = np.unique(triangle_sides(triangles), axis=0, return_counts=True)
    for wrong, what in (
        (uses == 1, "its surface is open: {} with a triangle on one side only"),
        (uses > 2, "its surface does not bound a solid: {} with more than two triangles"),
    ):
        if wrong.any():
            a, b = position[edges[np.argmax(wrong)]]
            text = what.format(_count(wrong, "edge", "edges"))
            raise BadMesh(f"{name}: {text}, the first from {point(a)} to {point(b)}")
    solids = solids_of(TriangleSurface(position, triangles))
    _check_pieces(solids, position[triangles].mean(axis=1), name, "closed by itself")
    a, b, c = np.moveaxis(position[triangles] - position[triangles[0, 0]], 1, 0)
    _check_volume(abs(np.einsum("ij,ij->", a, np.cross(b, c))) / 6, _diagonal(position), name)
    check_no_intersections(position, triangles, name)


def check_no_intersections(position: np.ndarray, triangles: np.ndarray, name: str) -> None:
    """Raise BadMesh with the first two triangles [F,3] that cut each other."""
    ipctk = load_ipctk()
    nodes, local = np.unique(triangles, return_inverse=True)
    # ipctk's test is made for parts of about unit size.
    vertices = np.asfortranarray((position[nodes] - position[nodes[0]]) / _diagonal(position))
    faces = np.asfortranarray(local.reshape(-1, 3), dtype=np.int32)
    edges = ipctk.edges(faces)
    mesh = ipctk.CollisionMesh(vertices, edges, faces)
    broad_phase = ipctk.LBVH()
    if not ipctk.has_intersections(mesh, vertices, broad_phase):
        return
    broad_phase.build(vertices, edges, faces, 1e-9)
    for candidate in broad_phase.detect_edge_face_candidates():
        edge = edges[candidate.edge_id]
        face = faces[candidate.face_id]
        if not set(edge) & set(face) and ipctk.is_edge_intersecting_triangle(*vertices[edge], *vertices[face]):
            owner = int(np.argmax(np.isin(faces, edge).sum(axis=1) == 2))
            where = position[triangles[candidate.face_id]].mean(axis=0)
            raise BadMesh(
                f"{name}: its surface cuts itself: the triangles {triangles[owner].tolist()} and"
                f" {triangles[candidate.face_id].tolist()} near {point(where)} meet"
            )
    raise BadMesh(f"{name}: its surface cuts itself")


def boundary(elements: np.ndarray) -> np.ndarray:
    """Triangles [F,3] of the faces that belong to only one tetrahedron, one of [E,4] and four of [E,10]. Normals point
    out if the elements have positive volume."""
    faces = np.sort(elements[:, np.array(LOCAL_FACES)].reshape(-1, 3), axis=1)
    _, first, count = np.unique(faces, axis=0, return_index=True, return_counts=True)
    owner, face = np.divmod(np.sort(first[count == 1]), 4)
    local = np.array(FACE_TRIANGLES[elements.shape[1]])[face]
    return np.take_along_axis(elements[owner][:, None, :], local, axis=2).reshape(-1, 3)


def _check_points(position: np.ndarray, name: str, what: str) -> None:
    finite = np.isfinite(position).all(axis=1)
    if not finite.all():
        index = int(np.argmin(finite))
        raise BadMesh(f"{name}: the position of node {index} is not finite: {point(position[index])}")
    pairs = KDTree(position).query_pairs(SAME_PLACE * _diagonal(position), output_type="ndarray")
    if len(pairs):
        a, b = pairs[np.lexsort(pairs.T[::-1])[0]]
        raise BadMesh(
            f"{name}: {counted(len(pairs), f'pair of {what} lies', f'pairs of {what} lie')} at one place, the first {a}"
            f" and {b} at {point(position[a])}: merge them"
        )


def _check_volume(volume: float, diagonal: float, name: str) -> None:
    if not volume > SMALLEST_VOLUME * diagonal**3:
        raise BadMesh(f"{name}: its volume, {volume:.3g}, is as good as zero for its size, {diagonal:.3g}")


def _check_pieces(label: np.ndarray, centre: np.ndarray, name: str, how: str) -> None:
    pieces = np.unique(label)
    if len(pieces) > 1:
        first, second = (centre[label == piece].mean(axis=0) for piece in pieces[:2])
        raise BadMesh(
            f"{name}: it has {len(pieces)} pieces {how}, the first two around {point(first)} and {point(second)};"
            " a part is one solid: give each a file of its own"
        )


def _element_pieces(elements: np.ndarray) -> np.ndarray:
    """The piece [E] that each tetrahedron belongs to. Tetrahedra that share a face belong to one piece."""
    faces = np.sort(elements[:, np.array(LOCAL_FACES)], axis=2).reshape(-1, 3)
    return connected_parts(np.stack(equal_rows(faces), axis=1) // 4, len(elements))


def _diagonal(position: np.ndarray) -> float:
    return float(np.linalg.norm(np.ptp(position, axis=0)))


def _count(mask: np.ndarray, one: str, many: str) -> str:
    return counted(int(mask.sum()), one, many)


def _at(element: int, elements: np.ndarray, centre: np.ndarray) -> str:
    return f"element {element} (nodes {elements[element].tolist()}) at {point(centre[element])}"
