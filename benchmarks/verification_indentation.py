"""Verification of contact against half-space theory: a rigid sphere (Hertz) and a rigid flat punch.

One quarter of the half-space is a graded box; on its outer faces the displacements of a point force on a half-space
are prescribed (Boussinesq), which a load of radius a approaches like (a / distance)^2, so that the box may be small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.simulate import mesh
from ast_sim.simulate.contact import Contact, ContactSettings
from ast_sim.simulate.elasticity import Elasticity
from ast_sim.simulate.material import NeoHookean
from benchmarks.verification_bodies import Rollers, cauchy, newton, nodal_areas, triangles
from benchmarks.verification_problem import (
    Curve,
    Outcome,
    Picture,
    Problem,
    more_than,
    observed_order,
    relative,
    richardson,
)

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
    found = []
    for depth in depths:
        target = rest.copy()
        target[far] += boussinesq(rest[far], force_at(depth))
        target[body == 1, 2] -= 2 * dhat + depth
        solver.step(target)
        position = rollers.seen(solver.position)
        force = solver.state.contact.gradient()[:, 2]
        found.append(
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
    return found


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


def sheet(extent: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat square [0, extent]^2 at z = 0 whose triangles face down: nodes [M,3], triangles [F,3]."""
    line = np.linspace(0, extent, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    position = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right, up = corner + cells + 1, corner + 1
    faces = np.concatenate([np.stack([corner, up, right], 1), np.stack([right, up, up + cells + 1], 1)])
    return position, faces


def disc(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Quarter of the unit disc at z = 0, facing down: the quarter of a square mapped onto it, keeping directions."""
    position, faces = sheet(1.0, cells)
    length = np.linalg.norm(position, axis=1, keepdims=True)
    largest = position.max(axis=1, keepdims=True)
    return position * np.divide(largest, length, out=np.zeros_like(length), where=length > 0), faces


def moment_radius(result: Indentation) -> float:
    """Radius, in contact radii, of a Hertzian pressure with the second moment of the one found: <r^2> = 2/5 a^2."""
    weight = result.pressure * result.nodal_area
    return float(np.sqrt(2.5 * (weight @ result.radius**2) / weight.sum()))


SPHERE_RADIUS = 100.0  # contact radii: strains of order a / R = 0.01, where the law is linear
SPHERE_DHAT = 5e-4  # a twentieth of the depth
PUNCH_DEPTH, PUNCH_DHAT = 0.01, 5e-4


def sphere_force(depth: float) -> float:
    """Hertz: F = 4/3 E* sqrt(R) delta^(3/2), in newton; 0 above the surface."""
    return 4 / 3 * PLANE_MODULUS * np.sqrt(SPHERE_RADIUS) * max(depth, 0.0) ** 1.5


def press_sphere(cells: int, steps: int) -> list[Indentation]:
    """The sphere pressed in until the contact radius is 1; the facets of the sphere are smaller than the cells."""
    full = 1 / SPHERE_RADIUS
    depths = [full * share - 0.99 * SPHERE_DHAT for share in np.linspace(0, 1, steps + 1)[1:]]
    return indent(cap(SPHERE_RADIUS, 2.0, int(2.7 * cells)), depths, sphere_force, cells, SPHERE_DHAT)


def hertz(cells: list[int]) -> Outcome:
    """Force, contact radius, pressure and stress on the axis under refinement."""
    paths = [press_sphere(n, 4 if n == cells[0] else 2) for n in cells]
    ends = [path[-1] for path in paths]
    ratios = [end.force / sphere_force(end.depth) for end in ends]
    order, limit = observed_order([1 / n for n in cells], ratios)
    uncertainty = abs(richardson(ratios[-2], ratios[-1], 2.0) - limit)
    end, finest = ends[-1], cells[-1]
    # Contact gives way by less than dhat - gap at the centre more at its edge; the far field is off by (a / D)^2 of its
    # share 0.42 a / D in the depth.
    softness = 1.5 * (SPHERE_DHAT - end.gap) / end.depth
    model = 1 / SPHERE_RADIUS + 0.42 / EXTENT**3 + softness
    a = np.sqrt(end.depth * SPHERE_RADIUS)
    p0 = 2 * PLANE_MODULUS * a / (np.pi * SPHERE_RADIUS)
    inner = end.radius < 0.5 * a
    centre = float(np.mean(end.pressure[inner] / np.sqrt(1 - (end.radius[inner] / a) ** 2)))
    shear = np.abs(end.axis_stress[:, 2, 2] - (end.axis_stress[:, 0, 0] + end.axis_stress[:, 1, 1]) / 2) / 2
    rows = [
        relative(
            f"force at the depth found, extrapolated from {', '.join(map(str, cells))} cells a radius / Hertz",
            1.0,
            limit,
            model + uncertainty,
            f"finite strain a/R, far field 0.42 (a/D)^3, softness 1.5 (dhat - gap)/delta: {model:.1e};"
            f" extrapolation {uncertainty:.0e}",
        ),
        relative(
            f"force at the depth found, {finest} cells a radius / Hertz",
            1.0,
            ratios[-1],
            0.05,
            "what is asked of 8 cells a radius or more: 5 %",
        ),
        relative(
            "contact radius from the second moment of the pressure, in radii of Hertz",
            a,
            moment_radius(end),
            0.5 / finest,
            f"half a cell, 1/{2 * finest}",
        ),
        relative(
            "pressure in the centre (nodes within a/2)",
            p0,
            centre,
            0.5 / finest,
            "p0 ~ F / a^2 with the force and the radius of this mesh: half a cell",
            "Pa",
        ),
        relative(
            "largest shear stress on the axis / p0",
            0.310,
            shear.max() / p0,
            0.5 / finest,
            "stress is constant in an element: half a cell along the axis",
        ),
        more_than("smallest det F", end.min_jacobian, 0.0, "no element is inverted"),
    ]
    return Outcome(
        rows,
        {
            "force": _force_picture("Rigid sphere on a half-space", paths, cells, sphere_force),
            "pressure": _pressure_picture(
                "Hertz: pressure", end, p0, a, lambda r: np.sqrt(np.maximum(1 - r**2, 0)), np.linspace(0, 1, 200)
            ),
            "axis": _axis_picture(end, p0, a),
            "convergence": _convergence_picture("Hertz: force under refinement", cells, ratios, order),
        },
        [
            "The force is too large by "
            + ", ".join(f"{100 * (r - 1):.1f} % with {n}" for n, r in zip(cells, ratios, strict=True))
            + f" cells over the contact radius: observed order {order:.2f}."
        ],
    )


def punch_force(depth: float) -> float:
    """F = 2 a E* delta, in newton; 0 above the surface."""
    return 2 * PLANE_MODULUS * max(depth, 0.0)


def press_punch(cells: int) -> list[Indentation]:
    """The flat end of a rigid cylinder of radius 1 pressed in, without friction."""
    depths = [share * PUNCH_DEPTH - 0.99 * PUNCH_DHAT for share in (0.5, 1.0)]
    return indent(disc(int(2.7 * cells)), depths, punch_force, cells, PUNCH_DHAT)


def punch(cells: list[int]) -> Outcome:
    """Force and pressure under refinement."""
    paths = [press_punch(n) for n in cells]
    ends = [path[-1] for path in paths]
    ratios = [end.force / punch_force(end.depth) for end in ends]
    order, limit = observed_order([1 / n for n in cells], ratios)
    uncertainty = abs(richardson(ratios[-2], ratios[-1], 1.0) - limit)
    end, finest = ends[-1], cells[-1]
    # The barrier acts up to dhat outside the rim; the far field as in `hertz`, where the share in the depth is
    # F (1 - nu^2) / (pi E D) / delta = 2 a / (pi D). The rim is a polygon inside the circle.
    polygon = (np.pi / (4 * int(2.7 * finest))) ** 2 / 6
    model = PUNCH_DEPTH + PUNCH_DHAT + 2 / np.pi / EXTENT**3 + polygon
    middle = end.radius < 0.5
    pressure = float(np.mean(end.pressure[middle] * np.sqrt(1 - end.radius[middle] ** 2)))
    expected = punch_force(end.depth) / (2 * np.pi)
    rows = [
        relative(
            f"force at the depth found, extrapolated from {', '.join(map(str, cells))} cells a radius / closed form",
            1.0,
            limit,
            model + uncertainty,
            f"finite strain delta/a, rim dhat/a, far field, polygon: {model:.1e}; extrapolation {uncertainty:.0e}",
        ),
        more_than("observed order", order, 0.75, "h: the pressure is singular like (distance to the rim)^-1/2", ""),
        relative(
            f"pressure within a/2 of the axis, times sqrt(1 - r^2/a^2), {finest} cells a radius",
            expected,
            pressure,
            1 / finest,
            "h/a: the same singularity moves load by O(h)",
            "Pa",
        ),
    ]
    return Outcome(
        rows,
        {
            "pressure": _pressure_picture(
                "Flat punch: pressure",
                end,
                expected,
                1.0,
                lambda r: 1 / np.sqrt(1 - r**2),
                np.linspace(0, 0.99, 200),
            ),
            "convergence": _convergence_picture("Flat punch: force under refinement", cells, ratios, order),
        },
        [
            "The force is too large by "
            + ", ".join(f"{100 * (r - 1):.1f} % with {n}" for n, r in zip(cells, ratios, strict=True))
            + f" cells over the radius: observed order {order:.2f}. Near a sharp edge expect an error of first order."
        ],
    )


def _force_picture(title: str, paths: list[list[Indentation]], cells: list[int], force) -> Picture:
    depth = np.linspace(0, max(path[-1].depth for path in paths), 100)
    curves = [Curve("closed form", depth, np.array([force(d) for d in depth]), "k-")]
    curves += [
        Curve(f"{n} cells a radius", np.array([r.depth for r in path]), np.array([r.force for r in path]), "o")
        for n, path in zip(cells, paths, strict=True)
    ]
    return Picture(title, "depth of the surface in the centre / a", "force in newton (E = 1 MPa, a = 1 m)", curves)


def _pressure_picture(title: str, end: Indentation, p0: float, a: float, shape, line: np.ndarray) -> Picture:
    near = end.radius < 1.6
    curves = [
        Curve("closed form", line * a, shape(line), "k-"),
        Curve("contact force / nodal area", end.radius[near], end.pressure[near] / p0, "."),
    ]
    return Picture(title, "distance from the axis / a", "pressure / that of the closed form in the centre", curves)


def _axis_picture(end: Indentation, p0: float, a: float) -> Picture:
    """Johnson (1985), eq. 3.45."""
    z = np.linspace(1e-6, 3, 200)
    axial = -1 / (1 + (z / a) ** 2)
    radial = -(1 + POISSON) * (1 - z / a * np.arctan(a / z)) + 0.5 / (1 + (z / a) ** 2)
    deep = end.axis_depth < 3
    found = end.axis_stress[deep] / p0
    return Picture(
        "Hertz: stress below the centre",
        "depth / a",
        "stress / p0",
        [
            Curve("sigma_z", z, axial, "k-"),
            Curve("sigma_r", z, radial, "k--"),
            Curve("sigma_z computed", end.axis_depth[deep], found[:, 2, 2], "o"),
            Curve("sigma_r computed", end.axis_depth[deep], (found[:, 0, 0] + found[:, 1, 1]) / 2, "s"),
        ],
    )


def _convergence_picture(title: str, cells: list[int], ratios: list[float], order: float) -> Picture:
    n, errors = np.array(cells), np.array(ratios) - 1
    return Picture(
        title,
        "cells over the contact radius",
        "relative error of the force",
        [
            Curve("computed", n, errors, "o-"),
            Curve("order 1", n, errors[0] * n[0] / n, "k:"),
            Curve("order 2", n, errors[0] * (n[0] / n) ** 2.0, "k--"),
        ],
        logarithmic=True,
    )


PROBLEMS = [
    Problem(
        "hertz",
        "Hertz: a rigid sphere on a half-space",
        "nu = 0.3, a / R = 0.01. F = 4/3 E* sqrt(R) delta^(3/2), a^2 = R delta, p = p0 sqrt(1 - r^2/a^2) with"
        " p0 = 2 E* a / (pi R), largest shear stress on the axis 0.310 p0 at the depth 0.48 a. delta is how far the"
        " surface goes down in the centre, so that the gap that the barrier keeps does not count. A quarter, 8 a wide"
        " and deep; on its outer faces the displacements of the point force F of the closed form (Boussinesq), in"
        " which the depth has a share of 5 %. All cells are halved from mesh to mesh.",
        lambda: hertz([3, 6, 12]),
        quick=None,
    ),
    Problem(
        "punch",
        "A rigid flat punch on a half-space",
        "The end of a cylinder of radius a, without friction, on the same half-space: F = 2 a E* delta,"
        " p = F / (2 pi a sqrt(a^2 - r^2)).",
        lambda: punch([2, 4, 8]),
        quick=None,
    ),
]
