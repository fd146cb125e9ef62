"""Verification of bending: a cantilever under a small load, and the elastica, both under refinement.

Linear tetrahedra are stiff in bending: a body with n elements over its thickness resists too much, by a share of about
n^-2. The figures under refinement show this order and the limit. The text beside them says what a user should conclude
from a single mesh.
"""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from benchmarks.verification.bodies import DeadLoad, Rollers, box, newton, on_box
from benchmarks.verification.problem import Curve, Outcome, Picture, Problem, Row, absolute, observed_order, relative

YOUNG = 1e6
SLENDERNESS = 10  # L / h of the cantilever, whose section is h x h with h = 1
DEFLECTION = 1e-3  # of its tip, over L: what is not linear is of the order of its square


def tip_force(layers: int, poisson: float) -> float:
    """Force in newton that holds the tip of the cantilever deflected; `layers` elements over its thickness.

    The root is clamped; the tip section is moved sideways as a whole but free along the axis and across.
    """
    size, cells = (SLENDERNESS, 1.0, 1.0), (SLENDERNESS * layers, layers, layers)
    rest, elements = box(size, cells)
    faces = on_box(rest, size)
    held = np.zeros(rest.shape, bool)
    held[faces[:, 0, 1], 2] = True
    target = rest + [0, 0, DEFLECTION * SLENDERNESS]
    potential = Rollers(Elasticity(rest, elements, NeoHookean(YOUNG, poisson)), held, target, YOUNG / layers)
    solver = newton(potential, rest, faces[:, 0, 0])
    solver.step(rest)
    return float(potential.reaction(solver.state.potential)[:, 2].sum())


def timoshenko(poisson: float) -> float:
    """Force in newton of a Timoshenko beam with the shear coefficient 10 (1 + nu) / (12 + 11 nu) (Cowper 1966)."""
    bending = SLENDERNESS**3 / (3 * YOUNG / 12)
    coefficient = 10 * (1 + poisson) / (12 + 11 * poisson)
    shear = SLENDERNESS / (coefficient * YOUNG / (2 * (1 + poisson)))
    return DEFLECTION * SLENDERNESS / (bending + shear)


def cantilever_study(poisson: float, layers: list[int]) -> tuple[list[Row], Picture, list[float]]:
    """Rows, convergence plot and relative errors on the meshes with these numbers of layers."""
    expected, forces = timoshenko(poisson), [tip_force(n, poisson) for n in layers]
    errors = [force / expected - 1 for force in forces]
    order, limit = observed_order([1 / n for n in layers], forces)
    # How far the next term, of order h^4, moves the limit: beside it the limit of the two finest meshes, with order 2.
    uncertainty = abs(forces[-1] + (forces[-1] - forces[-2]) / 3 - limit) / expected
    # The clamp keeps the root section from warping, and from contracting over about h / 2 where nu > 0: there the
    # stiffness is up to EI / (1 - nu^2), and that length takes part in the deflection by its share times 3.
    restraint = 0.6 / SLENDERNESS**3 + 1.5 * poisson**2 / SLENDERNESS
    name = f"nu = {poisson}"
    rows = [
        relative(
            f"{name}: tip force, extrapolated from {layers[-3]}, {layers[-2]} and {layers[-1]} layers",
            expected,
            limit,
            restraint + uncertainty,
            f"restraint of the root section, 0.6 (h/L)^3 + 1.5 nu^2 h/L = {restraint:.1e};"
            f" extrapolation {uncertainty:.0e}",
            "N",
        ),
        absolute(
            f"{name}: observed order of convergence",
            2.0,
            order,
            0.25,
            f"h^2 of P1 in energy; the next term, h^4, is 1/4 of it at most at {layers[-3]} layers",
        ),
    ]
    n = np.array(layers)
    picture = Picture(
        f"Cantilever, nu = {poisson}: P1 is too stiff by a share of h^2",
        "elements over the thickness",
        "relative error of the tip force",
        [
            Curve("computed", n, np.array(errors), "o-"),
            Curve("order 2", n, errors[-1] * (n[-1] / n) ** 2.0, "k--"),
        ],
        logarithmic=True,
    )
    return rows, picture, errors


def cantilever(layers: list[int], ratios: tuple[float, ...] = (0.0, 0.3)) -> Outcome:
    """With Poisson's ratio 0 beam theory is exact but for the warping of the root section."""
    rows, pictures, remarks = [], {}, []
    for poisson in ratios:
        made, picture, errors = cantilever_study(poisson, layers)
        rows += made
        pictures[f"nu_{poisson}".replace(".", "_")] = picture
        shares = ", ".join(f"{100 * error:.1f} % with {n}" for n, error in zip(layers, errors, strict=True))
        remarks.append(f"nu = {poisson}: too stiff by {shares} elements over the thickness.")
    remarks.append(
        "A part that bends needs eight elements over its thickness for its stiffness to be right to 10 %, sixteen for"
        " 3 %; with two its deflection is qualitative. Compare solvers on one mesh, not with reality."
    )
    return Outcome(rows, pictures, remarks)


# PL^2/EI, w/L, u/L of a cantilever with a transverse force at its tip that keeps its direction (Mattiasson 1981).
MATTIASSON = ((1.0, 0.30172, 0.05643), (2.0, 0.49346, 0.16064), (5.0, 0.71379, 0.38763), (10.0, 0.81061, 0.55500))
LENGTH = 50.0  # L / h of the elastica, h = 1


def elastica_path(layers: int) -> tuple[list[tuple[float, float]], list[np.ndarray]]:
    """(w/L, u/L) at the loads of `MATTIASSON`, and the shapes [M,2] of the middle line.

    A strip one cell wide on rollers at y = 0 and y = b with nu = 0: plane stress.
    """
    cells = (int(LENGTH) * layers, 1, layers)
    size = (LENGTH, 1 / layers, 1.0)
    rest, elements = box(size, cells)
    held = np.zeros(rest.shape, bool)
    held[:, 1] = True
    tip, root = on_box(rest, size)[:, 0, 1], on_box(rest, size)[:, 0, 0]
    height = rest[:, 2]
    share = np.where(tip, np.where((height == 0) | (height == 1), 0.5, 1.0), 0.0)
    share /= share.sum()
    elasticity = Rollers(Elasticity(rest, elements, NeoHookean(YOUNG, 0.0)), held, rest, YOUNG / layers)
    potential = DeadLoad(elasticity, np.zeros(rest.shape))
    solver = newton(potential, rest, root, tolerance=1e-6)
    middle = np.flatnonzero((height == 0.5) & (rest[:, 1] == 0))
    tips, shapes, stiffness = [], [], YOUNG * size[1] / 12
    loads = [load for load, _, _ in MATTIASSON]
    for load in range(1, 11):
        potential.force[:, 2] = load * stiffness / LENGTH**2 * share
        solver.step(solver.position)
        if load in loads:
            end = share @ (solver.position - rest) / LENGTH
            tips.append((float(end[2]), -float(end[0])))
            shapes.append((solver.position[middle][:, [0, 2]] - [0, 0.5]) / LENGTH)
    return tips, shapes


def elastica(layers: list[int]) -> Outcome:
    """Deflections under refinement and extrapolated."""
    paths = [elastica_path(n) for n in layers]
    rows, curves = [], []
    for case, (load, w, u) in enumerate(MATTIASSON):
        for what, expected, component in (("w/L", w, 0), ("u/L", u, 1)):
            values = [tips[case][component] for tips, _ in paths]
            order, limit = observed_order([1 / n for n in layers], values)
            uncertainty = abs(values[-1] + (values[-1] - values[-2]) / 3 - limit)
            # The elastica neither stretches nor shears. With the strains P sin(phi) / EA and P cos(phi) / (5/6 GA), w
            # grows by at most 0.2 and u by 0.06 times PL^2/EI (h/L)^2. With the strain e of the outer fibre at the root
            # the law's M = EI kappa (1 + 0.13 e^2): w changes by as much at most, u by twice that.
            strain = load * (1 - u) / (2 * LENGTH)
            beam = (0.2, 0.06)[component] * load / LENGTH**2
            law = 0.13 * strain**2 * expected * (component + 1)
            model = beam + law + 5e-6
            rows.append(
                absolute(
                    f"PL^2/EI = {load:g}: {what}, extrapolated from {layers[-3]}, {layers[-2]} and {layers[-1]} layers",
                    expected,
                    limit,
                    model + uncertainty,
                    f"stretch and shear of the strip {beam:.0e}, curvature of the law {law:.0e}, 5 digits;"
                    f" extrapolation {uncertainty:.0e}",
                )
            )
    for (load, w, u), shape in zip(MATTIASSON, paths[-1][1], strict=True):
        curves.append(Curve(f"PL^2/EI = {load:g}", shape[:, 0], shape[:, 1], "-"))
        curves.append(Curve("Mattiasson" if load == 10 else "", np.array([1 - u]), np.array([w]), "ko"))
    n = np.array(layers)
    errors = np.array([[abs(tips[i][0] - row[1]) for tips, _ in paths] for i, row in enumerate(MATTIASSON)])
    convergence = [
        Curve(f"PL^2/EI = {row[0]:g}", n, error, "o-") for row, error in zip(MATTIASSON, errors, strict=True)
    ]
    convergence.append(Curve("order 2", n, errors[0, 0] * (n[0] / n) ** 2.0, "k--"))
    worst = errors[:, -1].max()
    return Outcome(
        rows,
        {
            "shapes": Picture(f"Elastica: middle line, {layers[-1]} layers", "x / L", "z / L", curves, equal=True),
            "convergence": Picture(
                "Elastica under refinement", "elements over the thickness", "error of w / L", convergence, True
            ),
        },
        [f"On the finest mesh itself, {layers[-1]} layers, the largest error of w/L is {worst:.4f}."],
    )


PROBLEMS = [
    Problem(
        "cantilever",
        "Cantilever with a small load",
        "A beam 10 h long with a square section h x h, clamped at its root, its tip section moved sideways by L/1000;"
        " the force against Timoshenko's delta = P L^3 / (3 E I) + P L / (k G A) with Cowper's k."
        " On meshes of equal cells, each halved in all directions.",
        lambda: cantilever([2, 4, 8, 16]),
        quick=lambda: cantilever([2, 4, 8], (0.0,)),
    ),
    Problem(
        "elastica",
        "Elastica: large rotations",
        "A strip 50 h long in plane stress, nu = 0, clamped at its root, with a dead force P across its tip: deflection"
        " w and shortening u of the tip against Mattiasson's tables from elliptic integrals (Int. J. Numer. Meth. Engng"
        " 17, 1981). Loaded in steps of PL^2/EI = 1 from rest.",
        lambda: elastica([4, 8, 16]),
        quick=None,
    ),
]
