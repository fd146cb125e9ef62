"""What looks wrong in a mesh at rest: elements that stand twice, fold over each other or have no neighbour, nodes of no
element, points at one place, bodies inside each other.

Legend: N nodes, E elements.
"""

from __future__ import annotations

import numpy as np

from ast_sim.element_topology import equal_rows, folded_elements, point_volumes
from ast_sim.number_arrays import connected_parts
from ast_sim.plausibility.curved_elements import partly_inside_out
from ast_sim.plausibility.findings import Finding, places
from ast_sim.plausibility.overlaps import overlaps
from ast_sim.scene import Scene

# Points are at one place if they are nearer than this share of the size of the scene.
_SAME_PLACE = 1e-6


def at_rest(scene: Scene) -> list[Finding]:
    """What looks wrong in a scene at rest."""
    findings = [*_twice(scene), *_free_nodes(scene), *_single_elements(scene)]
    if scene.elements.shape[1] != 3:
        findings += [*_inside_out(scene), *folds(scene), *_faces_on_faces(scene), *overlaps(scene)]
    return findings


def _twice(scene: Scene) -> list[Finding]:
    rows = np.sort(equal_rows(np.sort(scene.elements, axis=1))[1])
    meaning = "the material is twice as stiff there, and faces between bodies are missed: write each element once"
    return [Finding("elements that stand twice", len(rows), _elements(scene, rows), meaning)] if len(rows) else []


def _free_nodes(scene: Scene) -> list[Finding]:
    used = np.zeros(scene.num_nodes, bool)
    used[scene.elements] = True
    rows = np.flatnonzero(~used)
    if not len(rows):
        return []
    meaning = "nothing holds them, and a model learns from them all the same: leave them out"
    return [Finding("nodes of no element", len(rows), places("nodes", rows, scene.rest_position[rows]), meaning)]


def _single_elements(scene: Scene) -> list[Finding]:
    part = connected_parts(scene.elements, scene.num_nodes)
    count = np.bincount(part[scene.elements[:, 0]])
    rows = np.flatnonzero(count[part[scene.elements[:, 0]]] == 1)
    if not len(rows) or scene.num_elements == 1:
        return []
    meaning = "an element without a neighbour: are points of one place not joined?"
    return [Finding("bodies of one element", len(rows), _elements(scene, rows), meaning)]


def _inside_out(scene: Scene) -> list[Finding]:
    """Elements that have no volume where forces are integrated, however their nodes are numbered; and second-order ones
    that have none elsewhere. In others a piece between nodes and curved edges may be inside out all the same."""
    volumes = np.where(scene.rest_volumes < 0, -1, 1) * point_volumes(scene.rest_position, scene.elements)
    wrong = (volumes <= 0).any(axis=0)
    rows = np.flatnonzero(wrong)
    meaning = "they are flat, or their edges are bent too far: they cannot be computed with"
    findings = [Finding("elements inside out", len(rows), _elements(scene, rows), meaning)] if len(rows) else []
    if len(volumes) == 1:
        return findings
    rows = np.flatnonzero(partly_inside_out(scene.rest_position, scene.elements) & ~wrong)
    meaning = "the node of an edge lies a quarter of it or more from the middle, or the edge is bent far: mesh it again"
    told = Finding("elements of which a part is inside out", len(rows), _elements(scene, rows), meaning)
    return [*findings, told] if len(rows) else findings


def no_scene(scene: Scene) -> list[Finding]:
    """What no bodies of tetrahedra can be at rest: inside each other, or folded so that elements are inside out."""
    return [] if scene.elements.shape[1] == 3 else [*folded_inside_out(scene), *overlaps(scene)]


def folded_inside_out(scene: Scene) -> list[Finding]:
    """As `folds`, if a tetrahedron is inside out. It may be numbered so, which does no harm."""
    may_fold = scene.elements.shape[1] != 3 and bool((scene.rest_volumes < 0).any())
    return folds(scene) if may_fold else []


def folds(scene: Scene) -> list[Finding]:
    """Faces of more than two elements, and faces whose two elements lie on the same side of them."""
    rows = folded_elements(scene.elements, scene.rest_volumes < 0)
    if not len(rows):
        return []
    meaning = "the mesh folds over itself there, so it cannot be computed with: mesh it again"
    return [Finding("elements that lie on each other", len(rows), _elements(scene, rows), meaning)]


def _faces_on_faces(scene: Scene) -> list[Finding]:
    """Faces of the surface that lie on another face, with points of their own."""
    from scipy.spatial import KDTree

    surface = scene.surface()
    nodes = np.unique(surface)
    if not len(nodes):  # each face has two elements, as where all lie on each other
        return []
    points = scene.rest_position[nodes].astype(np.float64)
    distance = _SAME_PLACE * float(np.ptp(points, axis=0).max())
    pairs = KDTree(points).query_pairs(distance, output_type="ndarray")
    if not len(pairs):
        return []
    place = np.arange(scene.num_nodes)
    for _ in range(3):  # chains of points at one place are short
        np.minimum.at(place, nodes[pairs[:, 1]], place[nodes[pairs[:, 0]]])
        np.minimum.at(place, nodes[pairs[:, 0]], place[nodes[pairs[:, 1]]])
    rows = surface[np.sort(equal_rows(np.sort(place[surface], axis=1))[1]), 0]
    if not len(rows):
        return []
    meaning = "bodies touch there at rest, or a mesh is not joined: one body needs common points"
    return [
        Finding("faces that lie on another face", len(rows), places("nodes", rows, scene.rest_position[rows]), meaning)
    ]


def _elements(scene: Scene, rows: np.ndarray) -> str:
    centre = scene.rest_position[scene.elements[rows[:1]]].mean(axis=1)
    return places("elements", rows, centre)
