"""Verification of cloth: its energies, free flight, rest, and scenes that equal their own mirror images."""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.contact_and_friction import ContactSettings
from ast_sim.mechanics.dynamics import BackwardEuler, ClothCase, DynamicSettings
from ast_sim.mechanics.elements.cloth import Cloth, ClothMaterial
from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.families.sphere_simple import icosphere
from benchmarks.verification.bodies import sheet
from benchmarks.verification.derivatives import Energy, difference_rows, indifference_rows, of_potential
from benchmarks.verification.problem import Curve, Outcome, Picture, Problem, Row, at_most, more_than

GRAVITY, TIME_STEP = 9.81, 0.01
ROUNDING = float(np.finfo(float).eps)
FABRIC = ClothMaterial(stretch=100.0, poisson=0.3, bending=2e-4, density=0.2)


def energies() -> list[Energy]:
    """Membrane and bending of a crumpled sheet: each alone, and with the tension field of a slack cloth."""
    flat, triangles = symmetric_sheet(0.5, 5)
    position = flat + np.random.default_rng(4).uniform(-0.02, 0.02, flat.shape)
    names = {
        "membrane": ClothMaterial(100.0, 0.3, 0.0, 0.2),
        "membrane, relaxed in compression": ClothMaterial(100.0, 0.3, 0.0, 0.2, compression=0.1),
        "bending": ClothMaterial(1e-9, 0.3, 1.0, 0.2),
    }
    return [
        of_potential(
            name,
            Cloth(flat, triangles, material),
            position,
            0.05,
            max(material.stretch * 0.25, material.bending),
        )
        for name, material in names.items()
    ]


def derivatives() -> Outcome:
    """Differences and frame indifference of the energies."""
    return Outcome([row for energy in energies() for row in difference_rows(energy) + indifference_rows(energy)])


def symmetric_sheet(size: float, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A square around the origin, its diagonals mirrored at x = 0 and y = 0: nodes [N,3], triangles [T,3]."""
    position, triangles = sheet(size, cells)
    position[:, :2] -= size / 2
    centre = position[triangles][:, :, :2].mean(axis=1)
    corner = triangles.reshape(2, cells * cells, 3)
    a, b, c, d = corner[0, :, 0], corner[0, :, 1], corner[0, :, 2], corner[1, :, 2]
    middle = (centre[: cells * cells] + centre[cells * cells :]) / 2
    flip = middle[:, 0] * middle[:, 1] > 0
    first = np.where(flip[:, None], np.stack([a, c, d], 1), np.stack([a, c, b], 1))
    second = np.where(flip[:, None], np.stack([a, d, b], 1), np.stack([c, d, b], 1))
    return position, np.concatenate([first, second])


def cloth_case(
    position: np.ndarray,
    triangles: np.ndarray,
    held: np.ndarray,
    gravity: float,
    obstacle: tuple[np.ndarray, np.ndarray] | None = None,
    velocity: np.ndarray | None = None,
) -> ClothCase:
    """A sheet with held nodes [N] bool and a rigid obstacle (nodes [M,3], triangles [F,3]) that stands still."""
    ball, ball_triangles = obstacle or (np.zeros((0, 3)), np.zeros((0, 3), int))
    node_type = np.full(len(position) + len(ball), NodeType.OBSTACLE, np.uint8)
    node_type[: len(position)] = np.where(held, NodeType.HANDLE, NodeType.NORMAL)
    scene = Scene(
        rest_position=np.concatenate([position, ball]).astype(np.float32),
        elements=np.concatenate([triangles, ball_triangles + len(position)]).astype(np.int32),
        node_type=node_type,
        body=np.repeat([0, 1], [len(position), len(ball)]).astype(np.int32),
    )
    targets = np.repeat(scene.rest_position[None].astype(float), 2, axis=0)
    settings = ContactSettings(2e-3, 300.0, self_contact=True)
    if velocity is not None:
        velocity = np.concatenate([velocity, np.zeros_like(ball)])
    return ClothCase(scene, targets, FABRIC, settings, TIME_STEP, (0.0, 0.0, -gravity), velocity)


def march(case: ClothCase, steps: int) -> tuple[BackwardEuler, np.ndarray, np.ndarray, float]:
    """The solver after `steps` steps, all energy [steps + 1] in joule, momentum [steps + 1,3], and the smallest gap."""
    solver = BackwardEuler(case, DynamicSettings(acceleration_tolerance=1e-6, max_iterations=200))
    mass = solver.mass[:, None]

    def energy() -> float:
        stored = solver.elastic_energy() + solver.state.contact.barrier_energy()
        return stored + solver.kinetic_energy() + solver.potential_energy()

    energies, momenta, gap = [energy()], [(mass * solver.velocity).sum(axis=0)], np.inf
    for _ in range(steps):
        solver.advance(case.prescribed_position[0])
        energies.append(energy())
        momenta.append((mass * solver.velocity).sum(axis=0))
        gap = min(gap, solver.contact.gap(solver.position))
    return solver, np.array(energies), np.array(momenta), gap


def mirror_error(position: np.ndarray, rest: np.ndarray) -> float:
    """Largest distance in metres between a node and the mirror image of its partner, over x -> -x and y -> -y."""
    worst = 0.0
    for axis in (0, 1):
        sign = np.where(np.arange(3) == axis, -1.0, 1.0)
        order, partner = (np.lexsort(np.round(points, 6).T) for points in (rest, rest * sign))
        worst = max(worst, float(np.abs(position[order] - (position * sign)[partner]).max()))
    return worst


def cloth() -> Outcome:
    """Free fall, flight and rest of a sheet."""
    steps = 30
    flat, triangles = symmetric_sheet(0.5, 6)
    free = np.zeros(len(flat), bool)
    # The stop test bounds the last Newton step by 1e-6 m/s^2 x dt^2; Newton leaves the square of it.
    stop = 1e-6 * TIME_STEP**2 * steps * (steps + 1) / 2
    solver, _, _, _ = march(cloth_case(flat, triangles, free, GRAVITY), steps)
    expected = -GRAVITY * TIME_STEP**2 * steps * (steps + 1) / 2
    start = solver_rest(flat)
    drift = np.abs(solver.position - start - [0, 0, expected]).max()
    still, _, _, _ = march(cloth_case(flat, triangles, free, 0.0), steps)
    velocity = np.random.default_rng(2).normal(0, 0.5, flat.shape)
    flying, energies, momenta, gap = march(cloth_case(flat, triangles, free, 0.0, velocity=velocity), steps)
    change = np.abs(momenta - momenta[0]).max() / np.abs(flying.mass[:, None] * velocity).sum()
    rows = [
        at_most("free fall: largest deviation of a node after 30 steps", drift, stop, "stop test in each step", "m"),
        at_most("at rest: largest displacement", np.abs(still.position - start).max(), 1e-12, "rounding", "m"),
        at_most(
            "crumpling in flight: largest change of momentum / sum of magnitudes",
            change,
            1e-6 * TIME_STEP * steps / 0.5,
            "stop test 1e-6 m/s^2 in each step, over the speed",
        ),
        _no_growth("crumpling in flight", energies),
        more_than("crumpling in flight: smallest gap to itself", gap, 0.0, "surfaces never touch", "m"),
    ]
    return Outcome(rows)


def solver_rest(position: np.ndarray) -> np.ndarray:
    """Positions as a scene stores them, in single precision."""
    return position.astype(np.float32).astype(float)


def _no_growth(name: str, energies: np.ndarray) -> Row:
    scale = np.abs(energies).max()
    growth = max(0.0, float(np.diff(energies).max())) / scale
    return at_most(
        f"{name}: largest growth of all energy in a step / energy", growth, 1e-9, "stop test, squared; it must not grow"
    )


def drape(steps: int) -> Outcome:
    """A sheet held at its four corners sags; one that is free falls on a sphere and drapes over it."""
    flat, triangles = symmetric_sheet(0.5, 10)
    corners = (np.abs(flat[:, :2]) > 0.249).all(axis=1)
    rest = solver_rest(flat)
    # Mirrored nodes are summed in another order: rounding eps, which grows with the condition of a thin sheet, its
    # membrane over its bending stiffness at the size of a triangle, Y h^2 / D.
    amplified = 1e3 * ROUNDING * FABRIC.stretch * 0.05**2 / FABRIC.bending
    source = f"rounding x membrane / bending stiffness x steps = {amplified * steps:.0e} of the size"
    hanging, hung, _, _ = march(cloth_case(flat, triangles, corners, GRAVITY), steps)
    ball, faces = icosphere(2)
    ball = _symmetric_ball(ball)
    obstacle = 0.12 * ball - [0, 0, 0.12 + 4e-3], faces
    draped, fallen, _, gap = march(cloth_case(flat, triangles, np.zeros(len(flat), bool), GRAVITY, obstacle), steps)
    sheet_nodes = slice(0, len(flat))
    below = draped.position[sheet_nodes][:, 2]
    rows = [
        at_most(
            f"hanging from its corners, {steps} steps: mirror images differ by, over the size",
            mirror_error(hanging.position, rest) / 0.5,
            amplified * steps,
            source,
        ),
        _no_growth("hanging from its corners", hung),
        at_most(
            f"draped over a sphere, {steps} steps: mirror images differ by, over the size",
            mirror_error(draped.position[sheet_nodes], rest) / 0.5,
            amplified * steps,
            source,
        ),
        more_than("draped: smallest gap", gap, 0.0, "surfaces never touch", "m"),
        more_than("draped: how far the corners hang below the top", float(np.ptp(below)), 0.1, "it did drape", "m"),
        _no_growth("draped", fallen),
    ]
    middle = np.abs(rest[:, 1]) < 1e-9
    line = np.argsort(rest[middle, 0])
    angle = np.linspace(0, 2 * np.pi, 100)
    curves = [
        Curve("hanging from corners", *hanging.position[middle][line][:, [0, 2]].T, "o-"),
        Curve("draped over a sphere", *draped.position[sheet_nodes][middle][line][:, [0, 2]].T, "s-"),
        Curve("sphere", 0.12 * np.cos(angle), 0.12 * np.sin(angle) - 0.12 - 4e-3, "k-"),
    ]
    return Outcome(rows, {"shapes": Picture("Cloth: section y = 0", "x in m", "z in m", curves, equal=True)})


def _symmetric_ball(ball: np.ndarray) -> np.ndarray:
    """The icosphere is symmetric to the coordinate planes but for rounding, which is taken away."""
    return np.round(ball, 7)


PROBLEMS = [
    Problem(
        "cloth_derivatives",
        "Membrane and bending: derivatives and frame indifference",
        "As for the solids: gradients and Hessians against differences, and a rotation that changes nothing.",
        derivatives,
        quick=derivatives,
    ),
    Problem(
        "cloth",
        "A sheet of cloth in flight and at rest",
        "The same of a sheet with membrane and bending energy and self-contact.",
        cloth,
        quick=cloth,
    ),
    Problem(
        "drape",
        "A sheet hanging and draped",
        "Symmetric scenes must stay symmetric, and lose energy: a square sheet held at its corners, and one that falls"
        " on a sphere. The mesh is its own mirror image.",
        lambda: drape(40),
        quick=None,
    ),
]
