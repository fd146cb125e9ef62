"""Verification of contact against half-space theory: a rigid sphere (Hertz) and a rigid flat punch."""

from __future__ import annotations

import numpy as np

from benchmarks.verification.halfspace import EXTENT, PLANE_MODULUS, POISSON, Indentation, cap, disc, indent
from benchmarks.verification.problem import (
    Curve,
    Outcome,
    Picture,
    Problem,
    more_than,
    observed_order,
    relative,
    richardson,
)


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
    paths = [press_sphere(n, 4 if n == cells[0] else 1) for n in cells]
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
            "the limit for 8 cells a radius or more: 5 %",
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
    return Picture(title, "distance from the axis / a", "pressure / closed form in the centre", curves)


def _axis_picture(end: Indentation, p0: float, a: float) -> Picture:
    """Johnson (1985), eq. 3.45."""
    z = np.linspace(1e-6, 3, 200)
    axial = -1 / (1 + (z / a) ** 2)
    radial = -(1 + POISSON) * (1 - z / a * np.arctan(a / z)) + 0.5 / (1 + (z / a) ** 2)
    deep = end.axis_depth < 3
    stress = end.axis_stress[deep] / p0
    return Picture(
        "Hertz: stress below the centre",
        "depth / a",
        "stress / p0",
        [
            Curve("sigma_z", z, axial, "k-"),
            Curve("sigma_r", z, radial, "k--"),
            Curve("sigma_z computed", end.axis_depth[deep], stress[:, 2, 2], "o"),
            Curve("sigma_r computed", end.axis_depth[deep], (stress[:, 0, 0] + stress[:, 1, 1]) / 2, "s"),
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
