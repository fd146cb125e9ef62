"""Verification of friction: a block that is pressed on a floor and pulled along it, and a block on a slope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ast_sim.mechanics.contact_and_friction import STICKING_SLIP, Contact, ContactSettings
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.inertia import Inertia
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from benchmarks.verification.bodies import DeadLoad, box, newton, sheet, triangles
from benchmarks.verification.problem import Curve, Outcome, Picture, Problem, at_most, relative

MATERIAL = NeoHookean(young=1e6, poisson=0.3)
DENSITY, GRAVITY = 1000.0, 9.81
SIZE, CELLS = (0.2, 0.2, 0.1), (3, 3, 2)
DHAT = 1e-3


@dataclass(frozen=True)
class Floor:
    """A block over a rigid floor: rest positions [N,3], which nodes are the floor's [N] and what can touch."""

    rest: np.ndarray
    floor: np.ndarray
    elasticity: Elasticity
    contact: Contact


def block_on_floor(friction: float, gap: float) -> Floor:
    """The block `gap` metres above a floor that is larger than it."""
    block, elements = box(SIZE, CELLS, jitter=0.2)
    floor, floor_faces = sheet(0.6, 6)
    floor = floor * [1, 1, 0] - [0.2, 0.2, gap]
    rest = np.concatenate([block, floor])
    body = np.repeat([0, 1], [len(block), len(floor)])
    faces = np.concatenate([triangles(block, elements), floor_faces[:, ::-1] + len(block)])
    settings = ContactSettings(DHAT, MATERIAL.young, friction)
    contact = Contact(rest, faces, body, settings)
    return Floor(rest, body == 1, Elasticity(rest, elements, MATERIAL), contact)


def drag() -> Outcome:
    """The top of the block is pressed down 2 % and then drawn along in steps."""
    friction, press, step, steps = 0.3, 0.02 * SIZE[2], 4e-4, 16
    scene = block_on_floor(friction, gap=2 * DHAT)
    top = (scene.rest[:, 2] > SIZE[2] - 1e-9) & ~scene.floor
    solver = newton(scene.elasticity, scene.rest, scene.floor | top, scene.contact, tolerance=1e-6)
    target = scene.rest.copy()
    for _ in range(4):
        target[top, 2] -= (press + 1.1 * DHAT) / 4
        solver.step(target)
    normal, tangential, excess = [], [], 0.0
    for _ in range(steps):
        target[top, 0] += step
        solver.step(target)
        force = solver.reactions()[scene.floor].sum(axis=0)
        normal.append(abs(force[2]))
        tangential.append(abs(force[0]))
        state = solver.state.contact
        pressed, rubbed = (np.linalg.norm(f, axis=1) for f in (state.barrier_gradient(), state.friction_gradient()))
        excess = max(excess, float((rubbed - friction * pressed).max() / pressed.max()))
    ratio = np.array(tangential) / np.array(normal)
    sliding = ratio[-4:]
    # In a sliding step every point slips by `step`, more than the sticking slip: friction is full. Its normal forces
    # come from one pass before; they change over the length of the block, so in a step by step / length.
    lag = step / SIZE[0]
    source = f"normal forces of one pass before: step / length of the block = {lag:.0e}"
    way = step * np.arange(1, steps + 1)
    rows = [
        relative(
            "sliding: tangential / normal force",
            friction,
            float(sliding.mean()),
            lag,
            source,
        ),
        at_most(
            "sliding: scatter of that ratio over four steps / mu",
            float(np.ptp(sliding)) / friction,
            lag,
            source,
        ),
        at_most(
            "Coulomb's cap: largest |t| - mu p of any surface node in any step / largest p",
            max(0.0, excess),
            lag * friction,
            source,
        ),
        at_most(
            "before sliding: largest tangential / (mu normal) force in the first step, less 1",
            max(0.0, ratio[0] / friction - 1),
            0.0,
            "friction never exceeds mu p",
        ),
    ]
    picture = Picture(
        "A pressed block drawn along a floor, mu = 0.3",
        "travel of the top in mm",
        "tangential / normal force",
        [
            Curve("computed", 1e3 * way, ratio, "o-"),
            Curve("mu", 1e3 * way[[0, -1]], np.array([friction, friction]), "k--"),
        ],
    )
    return Outcome(rows, {"ratio": picture})


def slide(tangent: float, friction: float, time_step: float, steps: int) -> np.ndarray:
    """How far the block has slid, mean over its nodes [steps + 1] in metres, on a slope with the tangent given.

    The floor stays level and gravity leans instead. The block first settles under the part of it across the floor.
    """
    scene = block_on_floor(friction, gap=0.95 * DHAT)
    mass = DENSITY * scene.elasticity.lumped_volume()
    weight = mass[:, None] * GRAVITY
    angle = np.arctan(tangent)
    loaded = DeadLoad(scene.elasticity, weight * [0, 0, -np.cos(angle)])
    inertia = Inertia(loaded, mass, 0.05)
    solver = newton(inertia, scene.rest, scene.floor, scene.contact, tolerance=1e-6)
    for _ in range(12):  # long steps from rest: the block comes to rest on the barrier
        inertia.predicted = solver.position
        solver.step(scene.rest)
    loaded.force = weight * [np.sin(angle), 0, -np.cos(angle)]
    inertia.weight = mass / time_step**2
    start = before = solver.position
    travel = [0.0]
    for _ in range(steps):
        here = solver.position
        inertia.predicted = 2 * here - before
        before = here
        solver.step(scene.rest)
        travel.append(float((mass @ (solver.position - start)[:, 0]) / mass.sum()))
    return np.array(travel)


def slope(shares: tuple[float, ...]) -> Outcome:
    """With tan(theta) these shares of mu: below and above the angle of friction."""
    friction, time_step, steps = 0.5, 0.02, 15
    n = np.arange(steps + 1)
    rows, curves = [], []
    for share in shares:
        tangent = share * friction
        travel = slide(tangent, friction, time_step, steps)
        angle = np.arctan(tangent)
        acceleration = max(0.0, GRAVITY * (np.sin(angle) - friction * np.cos(angle)))
        expected = acceleration * time_step**2 * n * (n + 1) / 2
        # A sticking contact creeps: it needs a slip of up to the sticking slip a step to carry its friction. And the
        # block leans by its shear, by rho g sin(theta) h^2 / G at most.
        lean = DENSITY * GRAVITY * np.sin(angle) * SIZE[2] ** 2 / MATERIAL.mu
        name = f"tan(theta) = {share:g} mu"
        if share < 1:
            rows.append(
                at_most(
                    f"{name}: travel in {steps} steps, sticks",
                    travel[-1],
                    steps * STICKING_SLIP * DHAT + lean,
                    f"{STICKING_SLIP} dhat a step by which friction is smoothed, and {lean:.0e} m of shear",
                    "m",
                )
            )
        else:
            rows.append(
                relative(
                    f"{name}: travel in {steps} steps, slides",
                    expected[-1],
                    travel[-1],
                    (STICKING_SLIP * DHAT + lean) / expected[-1],
                    f"the sticking slip {STICKING_SLIP} dhat before friction is full, and {lean:.0e} m of shear",
                    "m",
                )
            )
        curves += [
            Curve(f"{name}, computed", n * time_step, 1e3 * travel, "."),
            Curve("closed form" if share == shares[-1] else "", n * time_step, 1e3 * expected, "k-"),
        ]
    picture = Picture("A block on a slope, mu = 0.5", "seconds", "travel in mm", curves)
    return Outcome(rows, {"travel": picture})


PROBLEMS = [
    Problem(
        "drag",
        "Coulomb friction: a block drawn along a floor",
        "An elastic block pressed on a rigid floor, its top moved along: the tangential force grows until the block"
        " slides and is then mu times the normal force; at no node of the surface is it larger.",
        drag,
        quick=drag,
    ),
    Problem(
        "slope",
        "A block on a slope",
        "It sticks where tan(theta) < mu, and slides with the acceleration g (sin(theta) - mu cos(theta)) where it is"
        " larger: after n steps of backward Euler by a dt^2 n (n + 1) / 2. The floor stays level, gravity leans.",
        lambda: slope((0.9, 0.98, 1.1, 1.5)),
        quick=lambda: slope((0.98, 1.1)),
    ),
]
