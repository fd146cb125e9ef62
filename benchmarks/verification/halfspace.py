"""A half-space under a rigid indenter: its mesh, its far field, its solution at several depths.

A graded box is one quarter of the half-space. On its outer faces, the displacements of a point force on a half-space
are prescribed (Boussinesq). The displacements of a load of radius a approach them like (a / distance)^2, so the box may
be small. Lengths are in contact radii.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.simulate.shapes import mesh
from benchmarks.verification.bodies import Rollers, cauchy, newton, nodal_areas, sheet, triangles

YOUNG, POISSON = 1e6, 0.3
MATERIAL = NeoHookean(YOUNG, POISSON)
PLANE_MODULUS = YOUNG / (1 - POISSON**2)  # E* of an elastic half-space and a rigid body
EXTENT = 8.0  # of the box, in contact radii
GROWTH = np.exp(2.4)  # outside the contact a cell is larger than the one before by this to the power of 1 / cells


def graded(cells: int, fine: float) -> np.ndarray:
    """Coordinates from 0 to about EXTENT: cells of 1 / cells up to `fine`, growing ones beyond.

    Twice as many cells halve all cells, also the growing ones: a sequence of such meshes has one order.
    """
    line, size = list(np.arange(round(fine * cells) + 1) / cells), 1 / cells
    while line[-1] < EXTENT:
        size *= GROWTH ** (1 / cells)
        line.append(line[-1] + size)
    outer = np.array(line)
    outer[outer > fine] = fine + (outer[outer > fine] - fine) * (EXTENT - fine) / (outer[-1] - fine)
    return outer


def quarter_space(cells_per_radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Quarter x, y >= 0 of the half-space z <= 0, in contact radii: positions [N,3], tetrahedra [E,4]."""
    side, depth = graded(cells_per_radius, 1.5), graded(cells_per_radius, 1.0)
    coordinates, elements = mesh.hexahedral_grid((len(side) - 1, len(side) - 1, len(depth) - 1))
    position = np.stack([side[coordinates[:, 0]], side[coordinates[:, 1]], -depth[::-1][coordinates[:, 2]]], axis=1)
    return position, elements


def boussinesq(position: np.ndarray, force: float) -> np.ndarray:
    """Displacements [M,3] of the half-space z <= 0 under a force down at the origin, in newton (Johnson 1985, 3.2)."""
    x, y, z = position[:, 0], position[:, 1], -position[:, 2]
    rho = np.linalg.norm(position, axis=1)
    factor = force / (4 * np.pi * MATERIAL.mu)
    radial = factor * (z / rho**3 - (1 - 2 * POISSON) / (rho * (rho + z)))
    down = factor * (z**2 / rho**3 + 2 * (1 - POISSON) / rho)
    return np.stack([radial * x, radial * y, -down], axis=1)


@dataclass(frozen=True)
class Indentation:
    """What was found at one depth, for the whole body (four quarters); lengths in contact radii.

    Attributes:
        depth: how far the surface has gone down in the centre.
        gap: between the surface and the indenter there.
        force: on the indenter, in newton.
        radius: rest distance [M] of the surface nodes from the axis.
        pressure: contact force over rest area [M] at them, in pascal.
        nodal_area: that rest area [M].
        axis_depth, axis_stress: depth [K] and stress [K,3,3] of elements near the axis, mean over each layer.
        min_jacobian: smallest det F.
        iterations: Newton iterations so far.
    """

    depth: float
    gap: float
    force: float
    radius: np.ndarray
    pressure: np.ndarray
    nodal_area: np.ndarray
    axis_depth: np.ndarray
    axis_stress: np.ndarray
    min_jacobian: float
    iterations: int


def indent(
    indenter: tuple[np.ndarray, np.ndarray], depths: list[float], force_at, cells_per_radius: int, dhat: float
) -> list[Indentation]:
    """Press a rigid indenter into the half-space.

    Args:
        indenter: nodes [M,3], the lowest at z = 0, and triangles [F,3] of its quarter x, y >= 0.
        depths: how far its lowest point goes below z = 0.
        force_at: closed form of the force at a depth, for the displacements far away.
        cells_per_radius: finest cells of the half-space.
        dhat: of the contact.
    """
    soil, elements = quarter_space(cells_per_radius)
    rest = np.concatenate([soil, indenter[0] + [0, 0, 2 * dhat]])
    body = np.repeat([0, 1], [len(soil), len(indenter[0])])
    lower = soil.min(axis=0)
    far = np.zeros(len(rest), bool)
    far[: len(soil)] = (soil[:, 2] == lower[2]) | (soil[:, :2] == soil[:, :2].max(axis=0)).any(axis=1)
    held = np.zeros(rest.shape, bool)
    held[: len(soil), :2] = soil[:, :2] == 0
    top = triangles(soil, elements)
    top = top[(soil[top, 2] == 0).all(axis=1)]
    faces = np.concatenate([top, indenter[1] + len(soil)])
    elasticity = Elasticity(rest, elements, MATERIAL)
    rollers = Rollers(elasticity, held & ~far[:, None], rest, YOUNG)
    contact = Contact(rest, faces, body, ContactSettings(dhat, YOUNG))
    solver = newton(rollers, rest, far | (body == 1), contact, 1e-6)
    area = nodal_areas(soil, top, np.ones(len(soil), bool))
    surface = np.unique(top)
    centre = int(np.argmin(np.linalg.norm(soil, axis=1)))
    results = []
    for depth in depths:
        target = rest.copy()
        target[far] += boussinesq(rest[far], force_at(depth))
        target[body == 1, 2] -= 2 * dhat + depth
        solver.step(target)
        position = rollers.seen(solver.position)
        force = solver.state.contact.gradient()[:, 2]
        results.append(
            Indentation(
                depth=-position[centre, 2],
                gap=-depth - position[centre, 2],
                force=4 * float(force[: len(soil)].sum()),
                radius=np.linalg.norm(soil[surface, :2], axis=1),
                pressure=force[surface] / area[surface],
                nodal_area=area[surface],
                **_on_axis(elasticity, position, rest),
                min_jacobian=float(elasticity.evaluate(position).J.min()),
                iterations=solver.iterations,
            )
        )
    return results


def _on_axis(elasticity: Elasticity, position: np.ndarray, rest: np.ndarray) -> dict[str, np.ndarray]:
    """Mean stress of the elements in the cells along the axis, layer by layer."""
    centres = rest[elasticity.elements].mean(axis=1)
    cell = np.sort(np.unique(rest[:, 0][rest[:, 0] > 0]))[0]
    near = np.flatnonzero((centres[:, :2] < cell).all(axis=1))
    stress = cauchy(elasticity, position)[:, :, near]
    layer = np.searchsorted(np.unique(rest[elasticity.elements][:, :, 2]), centres[near, 2])
    layers = np.unique(layer)
    mean = np.array([stress[:, :, layer == k].mean(axis=2) for k in layers])
    return {
        "axis_depth": np.array([-centres[near][layer == k, 2].mean() for k in layers]),
        "axis_stress": mean,
    }


def cap(radius: float, extent: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Quarter of a spherical cap over [0, extent]^2, its lowest point at the origin: nodes [M,3], triangles [F,3]."""
    position, faces = sheet(extent, cells)
    position[:, 2] = radius - np.sqrt(radius**2 - (position[:, :2] ** 2).sum(axis=1))
    return position, faces


def disc(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Quarter of the unit disc at z = 0, facing down: the quarter of a square mapped onto it, keeping directions."""
    position, faces = sheet(1.0, cells)
    length = np.linalg.norm(position, axis=1, keepdims=True)
    largest = position.max(axis=1, keepdims=True)
    return position * np.divide(largest, length, out=np.zeros_like(length), where=length > 0), faces
