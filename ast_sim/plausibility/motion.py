"""What looks wrong in the frames of a simulation: tools that change their shape, displacements in other units, elements
that turn over, frames that stop dead, bodies that change their places, displacements from the frame before, no motion,
Poisson's ratios, yield stresses and stresses that cannot be one, plastic strains of elastic bodies, reactions with the
other sign, contact that no model can see.

Legend: S frames, N nodes, E elements.
"""

from __future__ import annotations

import math

import numpy as np

from ast_sim.element_topology import signed_volumes
from ast_sim.material import POISSON, listed_columns
from ast_sim.number_arrays import point
from ast_sim.plausibility.body_places import change_places
from ast_sim.plausibility.findings import Finding, places
from ast_sim.plausibility.increments import counted_from_frame_before
from ast_sim.plausibility.plastic_strain import plastic_but_elastic
from ast_sim.plausibility.topology import at_rest
from ast_sim.plausibility.units import yielding
from ast_sim.plausibility.work_of_reactions import negative_work
from ast_sim.scene import Scene, Trajectory

# Edges of an obstacle keep their lengths up to this share of the longest edge.
_RIGID = 0.02

# A displacement above this multiple of the size of the scene cannot be one.
_FAR = 10.0

# A node moves if it moves by more than this share of the size of its scene.
_STILL = 1e-6

# More world edges than this for each node, and an octree deeper than this, tell of a mesh in other units or of a stray
# part.
_MOST_WORLD_EDGES = 60
_DEEPEST = 14

# A von Mises stress that is carried from elements to nodes may be negative by this share of the largest.
_OVERSHOOT = 0.05

# Frames in which world edges are counted.
_FRAMES = 5


def in_trajectory(trajectory: Trajectory, dynamic: bool = False) -> list[Finding]:
    """What looks wrong in a simulation. What the bundled solver makes has nothing of it."""
    scene = trajectory.scene
    position = trajectory.position
    findings = [
        *at_rest(scene),
        *_poisson(trajectory),
        *yielding(trajectory),
        *plastic_but_elastic(trajectory),
        *_still(scene, position),
        *_far(scene, position),
        *_soft_tools(scene, position),
    ]
    findings += _turn_over(scene, position)
    if dynamic:
        findings += _stops_dead(position)
    else:
        of_others = "source" in trajectory.attributes  # of the bundled solver, a pause is one
        findings += [*(_pauses(position) if of_others else ()), *negative_work(trajectory)]
    findings += negative_stress(trajectory)
    findings += [*change_places(scene, position), *counted_from_frame_before(scene, position)]
    return [*findings, *_contact(scene, position)]


def _poisson(trajectory: Trajectory) -> list[Finding]:
    scene = trajectory.scene
    columns = listed_columns(trajectory.attributes)
    if scene.material is None or POISSON not in columns:
        return []
    ratio = scene.material[:, columns.index(POISSON)]
    rows = np.flatnonzero(scene.deforming_elements & ~((ratio > -1) & (ratio < 0.5)))
    if not len(rows):
        return []
    meaning = f"it is {ratio[rows[0]]:g} and must lie between -1 and 0.5: is it the field of another quantity?"
    return [Finding("elements whose Poisson's ratio cannot be one", len(rows), places("elements", rows), meaning)]


def negative_stress(trajectory: Trajectory) -> list[Finding]:
    """Stresses below zero by more than a smooth field is that was carried from elements to nodes."""
    if trajectory.stress is None:
        return []
    stress = trajectory.stress[:, trajectory.scene.deforming(trajectory.stress_at), 0]
    frames, rows = np.nonzero(stress < -_OVERSHOOT * np.abs(stress).max(initial=0))
    if not len(rows):
        return []
    worst = int(np.argmin(stress[frames, rows]))
    where = f"the lowest is {stress[frames, rows][worst]:.3g} in frame {frames[worst]}"
    meaning = "no von Mises stress is negative: is it a component, a principal stress or a pressure?"
    return [Finding("stresses below zero", len(rows), where, meaning)]


def _still(scene: Scene, position: np.ndarray) -> list[Finding]:
    size = float(np.ptp(scene.rest_position, axis=0).max())
    if len(position) < 2 or np.abs(position - position[0]).max() > _STILL * size:
        return []
    meaning = "nothing moves in any frame, so there is nothing to learn: name the field of the displacement"
    return [Finding("simulations without motion", 1, f"{len(position)} frames", meaning)]


def _far(scene: Scene, position: np.ndarray) -> list[Finding]:
    size = float(np.ptp(scene.rest_position, axis=0).max())
    moved = np.linalg.norm(position.astype(np.float64) - scene.rest_position, axis=2)
    largest = moved.max(axis=1)
    rows = np.flatnonzero(largest > _FAR * size)
    if not len(rows):
        return []
    where = places("frames", rows)
    beside = f"{largest.max() / size:.3g} times the size of the scene" if size else "from one point"
    meaning = f"nodes move by {largest.max():.3g}, {beside}: are displacement and mesh in one unit?"
    return [Finding("frames with very large displacements", len(rows), where, meaning)]


def _soft_tools(scene: Scene, position: np.ndarray) -> list[Finding]:
    edges = scene.edges()
    edges = edges[~scene.deforming_nodes[edges].any(axis=1)]
    if not len(edges):
        return []
    rest = _lengths(scene.rest_position, edges)
    worst = np.zeros(len(edges))
    for frame in position:
        worst = np.maximum(worst, np.abs(_lengths(frame, edges) - rest))
    rows = edges[worst > _RIGID * rest.max()][:, 0]
    if not len(rows):
        return []
    where = places("nodes", np.unique(rows), scene.rest_position[np.unique(rows)])
    meaning = f"edges of an obstacle change by up to {worst.max():.3g}: it is no rigid tool; mark clamps as handles"
    return [Finding("edges of obstacles that change", len(rows), where, meaning)]


def _turn_over(scene: Scene, position: np.ndarray) -> list[Finding]:
    if scene.elements.shape[1] == 3:
        return []
    sign = np.sign(scene.rest_volumes)
    count = 0
    first = None
    frames = []
    for number, frame in enumerate(position):
        wrong = (signed_volumes(frame, scene.elements) * sign <= 0) & scene.deforming_elements & (sign != 0)
        if wrong.any():
            count += int(wrong.sum())
            frames.append(number)
            first = first or f"frame {number}, element {np.argmax(wrong)}"
    if not frames:
        return []
    meaning = f"in {len(frames)} of {len(position)} frames elements are inside out: did the solver converge there?"
    return [Finding("elements that turn over", count, first or "", meaning)]


def _stops_dead(position: np.ndarray) -> list[Finding]:
    """Frames with the positions of the frame before, which had moved: with inertia nothing stops at once."""
    same = (position[1:] == position[:-1]).all(axis=(1, 2))
    rows = 2 + np.flatnonzero(same[1:] & ~same[:-1])
    if not len(rows):
        return []
    meaning = "each is the frame before it once more, but inertia does not stop at once: was it written twice?"
    return [Finding("frames that repeat", len(rows), places("frames", rows), meaning)]


def _pauses(position: np.ndarray) -> list[Finding]:
    """Frames with the positions of the frame before, where others move. Without inertia a frame is the one before once
    more wherever all prescribed nodes hold still."""
    same = (position[1:] == position[:-1]).all(axis=(1, 2))
    rows = 1 + np.flatnonzero(same)
    if not len(rows) or same.all():
        return []
    meaning = "each is the frame before it once more: a pause of the motion, or was it written twice?"
    return [Finding("frames that repeat", len(rows), places("frames", rows), meaning, may_be_meant=True)]


def _contact(scene: Scene, position: np.ndarray) -> list[Finding]:
    """World edges (nodes of two bodies within a mesh spacing) and the depth of the octree that the mesh implies."""
    from scipy.spatial import KDTree

    deforming = scene.edges()
    deforming = deforming[scene.deforming_nodes[deforming].any(axis=1)]
    if not len(deforming):
        return []
    spacing = float(_lengths(scene.rest_position, deforming).mean())
    half = 0.5 * float(np.ptp(position.reshape(-1, 3), axis=0).max())
    findings = []
    if spacing > 0 and half / spacing > 2**_DEEPEST:
        far = position[0][np.argmax(np.linalg.norm(position[0] - np.median(position[0], axis=0), axis=1))]
        meaning = f"the scene is {2 * half / spacing:.3g} mesh spacings across: is a part or a frame in another unit?"
        findings.append(
            Finding("levels of cells", math.ceil(math.log2(half / spacing)), f"node at {point(far)}", meaning)
        )
    if len(np.unique(scene.body)) < 2:
        return findings
    most = 0
    for frame in np.unique(np.linspace(0, len(position) - 1, _FRAMES).astype(int)).tolist():
        tree = KDTree(position[frame])
        total = tree.count_neighbors(tree, spacing) - scene.num_nodes
        inner = 0
        for body in np.unique(scene.body):
            own = KDTree(position[frame][scene.body == body])
            inner += own.count_neighbors(own, spacing) - int((scene.body == body).sum())
        most = max(most, int(total - inner))
    if most > _MOST_WORLD_EDGES * scene.num_nodes:
        meaning = f"of {scene.num_nodes} nodes; bodies lie in each other, or their meshes differ in size by far"
        findings.append(Finding("world edges in a frame", most, f"within {spacing:.3g}", meaning))
    return findings


def _lengths(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    ends = points[edges].astype(np.float64)
    return np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
