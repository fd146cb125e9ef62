"""Verification of the elastic solid: states of constant strain. Linear tetrahedra represent them exactly."""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from benchmarks.verification.bodies import Rollers, box, cauchy, newton, on_box
from benchmarks.verification.problem import Curve, Outcome, Picture, Problem, Row, at_most, relative

YOUNG, POISSON = 1e6, 0.4
MATERIAL = NeoHookean(YOUNG, POISSON)
MU, LAMBDA = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))  # of the closed forms
SIZE, CELLS = (1.0, 0.8, 0.6), (4, 4, 4)
# The solver accepts a residual force of 1e-8 E h^2 a node at least: its floor, about the rounding of sums of forces.
STOP = 1e-8
STOP_SOURCE = f"stop test: residuals up to {STOP:.0e} E h^2 a node, over {max(CELLS)} cells; constant strain is exact"
STOP_TOLERANCE = STOP * max(CELLS)


def body() -> tuple[np.ndarray, Elasticity]:
    """A box of tetrahedra whose nodes are moved at random."""
    rest, elements = box(SIZE, CELLS, jitter=0.3)
    return rest, Elasticity(rest, elements, MATERIAL)


def with_affine_boundary(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [N,3] of the box with its surface at F X, F X, and the Cauchy stress [3,3,E]; solved in four steps."""
    rest, elasticity = body()
    solver = newton(elasticity, rest, on_box(rest, SIZE).any(axis=(1, 2)))
    for share in (0.25, 0.5, 0.75, 1.0):
        solver.step(rest @ (np.eye(3) + share * (F - np.eye(3))).T)
    return solver.position, rest @ F.T, cauchy(elasticity, solver.position)


def patch() -> Outcome:
    """Affine displacement of the boundary, a full gradient."""
    F = np.eye(3) + np.array([[0.1, 0.05, 0.0], [-0.04, -0.08, 0.1], [0.02, 0.0, 0.06]])
    position, expected, stress = with_affine_boundary(F)
    J = np.linalg.det(F)
    exact = (MU * (F @ F.T - np.eye(3)) + LAMBDA / 2 * (J**2 - 1) * np.eye(3)) / J
    error = np.abs(position - expected).max() / max(SIZE)
    spread = np.abs(stress - exact[:, :, None]).max() / YOUNG
    rounding = "rounding, 1e-16 x condition of the stiffness (about 1e3), with a margin of 1e3"
    return Outcome(
        [
            at_most("largest displacement error of inner nodes / length of the box", error, 1e-10, rounding),
            at_most("largest error of a stress component of an element / E", spread, 1e-9, f"{rounding}, over h"),
        ]
    )


def homogeneous_rows(name: str, F: np.ndarray, expected: dict[str, float]) -> list[Row]:
    """Rows of the mean stress components, such as {"xy": 1.0}, and of their largest deviation in any element."""
    _, _, stress = with_affine_boundary(F)
    rows = []
    for component, value in expected.items():
        i, j = ("xyz".index(axis) for axis in component)
        label = f"{name}: sigma_{component}"
        if value:
            rows.append(relative(label, value, stress[i, j].mean(), STOP_TOLERANCE, STOP_SOURCE, "Pa"))
        deviation = np.abs(stress[i, j] - value).max() / YOUNG
        rows.append(at_most(f"{label}, largest deviation of an element / E", deviation, STOP_TOLERANCE, STOP_SOURCE))
    return rows


def shear() -> Outcome:
    """Simple shear: sigma_xy = mu gamma, sigma_xx = mu gamma^2."""
    rows, amounts = [], (0.1, 1.0)
    for gamma in amounts:
        F = np.eye(3)
        F[0, 1] = gamma
        rows += homogeneous_rows(f"gamma = {gamma}", F, {"xy": MU * gamma, "xx": MU * gamma**2, "yy": 0.0, "zz": 0.0})
    return Outcome(rows)


def hydrostatic() -> Outcome:
    """F = a I: sigma = [mu (a^2 - 1) + lambda/2 (a^6 - 1)] / a^3."""
    rows = []
    for a in (0.8, 1.25):
        stress = (MU * (a**2 - 1) + LAMBDA / 2 * (a**6 - 1)) / a**3
        rows += homogeneous_rows(f"a = {a}", a * np.eye(3), {"xx": stress, "zz": stress, "xy": 0.0})
    return Outcome(rows)


def uniaxial_closed_form(stretch):
    """Squared lateral stretch and Cauchy stress in pascal of Ciarlet's material, free at its sides."""
    lateral = (-MU + np.sqrt(MU**2 + LAMBDA * stretch**2 * (2 * MU + LAMBDA))) / (LAMBDA * stretch**2)
    return lateral, MU * (stretch**2 - lateral) / (stretch * lateral)


def uniaxial_states(stretches: list[float]) -> list[tuple[float, float, float, float]]:
    """Lateral stretch, mean axial stress, its largest deviation, and nominal stress (force / rest area) at each."""
    rest, elasticity = body()
    faces = on_box(rest, SIZE)
    held = faces[:, :, 0].copy()
    held[:, 2] |= faces[:, 2, 1]
    rollers = Rollers(elasticity, held, rest, stiffness=YOUNG * 0.1)
    solver = newton(rollers, rest)
    states = []
    for stretch in stretches:
        rollers.value[:, 2] = stretch * rest[:, 2]
        solver.step(solver.position)
        stress = cauchy(elasticity, rollers.seen(solver.position))
        lateral = solver.position[faces[:, 0, 1], 0].mean() / SIZE[0]
        force = rollers.reaction(solver.state.potential)[faces[:, 2, 1], 2].sum()
        spread = np.abs(stress[2, 2] - stress[2, 2].mean()).max()
        states.append((lateral, stress[2, 2].mean(), spread, force / (SIZE[0] * SIZE[1])))
    return states


def uniaxial() -> Outcome:
    """A bar on rollers pulled and pressed, free at its sides."""
    rows, points = [], []
    for path in ([1.1, 1.25, 1.5, 1.75, 2.0], [0.9, 0.85, 0.8, 0.75, 0.7]):
        states = uniaxial_states(path)
        points += zip(path, states, strict=True)
        (lateral, stress, spread, nominal), stretch = states[-1], path[-1]
        s, sigma = uniaxial_closed_form(stretch)
        name = f"stretch {stretch}"
        rows += [
            relative(f"{name}: lateral stretch", np.sqrt(s), lateral, STOP_TOLERANCE, STOP_SOURCE),
            relative(f"{name}: Cauchy stress", sigma, stress, STOP_TOLERANCE, STOP_SOURCE, "Pa"),
            relative(f"{name}: force / rest area", sigma * s, nominal, STOP_TOLERANCE, STOP_SOURCE, "Pa"),
            at_most(f"{name}: largest deviation of an element / E", spread / YOUNG, STOP_TOLERANCE, STOP_SOURCE),
        ]
    line = np.linspace(0.65, 2.05, 100)
    s, sigma = uniaxial_closed_form(line)
    points.sort()
    x = np.array([stretch for stretch, _ in points])
    states = np.array([state for _, state in points])
    picture = Picture(
        "Uniaxial tension and pressure, Ciarlet's law, nu = 0.4",
        "stretch",
        "stress / E",
        [
            Curve("Cauchy, closed form", line, sigma / YOUNG, "k-"),
            Curve("nominal, closed form", line, sigma * s / YOUNG, "k--"),
            Curve("Cauchy, computed", x, states[:, 1] / YOUNG, "o"),
            Curve("nominal, computed", x, states[:, 3] / YOUNG, "s"),
        ],
    )
    return Outcome(rows, {"stress": picture})


PROBLEMS = [
    Problem(
        "patch",
        "Patch test",
        "A box of 4 x 4 x 4 cells cut into tetrahedra, nodes moved at random by up to 0.3 cells; its surface is given"
        " the affine positions F X, the inside is solved for. It must be the same affine map, with one stress.",
        patch,
        quick=patch,
    ),
    Problem(
        "uniaxial",
        "Uniaxial tension and pressure",
        "The same box on rollers (x = 0, y = 0, z = 0), its top moved along z, its sides free. With the stretch l:"
        " lateral stretch squared s = [-mu + sqrt(mu^2 + lambda l^2 (2 mu + lambda))] / (lambda l^2), Cauchy stress"
        " mu (l^2 - s) / (l s), force over rest area that times s.",
        uniaxial,
        quick=uniaxial,
    ),
    Problem(
        "shear",
        "Simple shear",
        "x = X + gamma Y on the surface: sigma_xy = mu gamma, sigma_xx = mu gamma^2, all else 0 (J = 1).",
        shear,
        quick=shear,
    ),
    Problem(
        "hydrostatic",
        "Hydrostatic stretch",
        "x = a X on the surface: sigma = [mu (a^2 - 1) + lambda/2 (a^6 - 1)] / a^3 in all directions.",
        hydrostatic,
        quick=hydrostatic,
    ),
]
