"""Verification of backward Euler: an elastic body in free flight and at rest.

Backward Euler dissipates: energy must never grow, and momentum must be kept. A free fall follows the closed form z_n =
-g dt^2 n (n + 1) / 2 exactly.
"""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.inertia import Inertia
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from benchmarks.verification.bodies import DeadLoad, box, newton
from benchmarks.verification.problem import Curve, Outcome, Picture, Problem, at_most, relative

GRAVITY, TIME_STEP = 9.81, 0.01


class Flight:
    """An elastic box in flight, integrated by the solver with its inertia; `gravity` in m/s^2 along -z."""

    def __init__(self, velocity: np.ndarray, gravity: float) -> None:
        self.rest, elements = box((0.2, 0.15, 0.1), (3, 3, 3), jitter=0.2)
        self.elasticity = Elasticity(self.rest, elements, NeoHookean(1e5, 0.3))
        self.mass = 1e3 * self.elasticity.lumped_volume()
        loaded = DeadLoad(self.elasticity, self.mass[:, None] * [0, 0, -gravity])
        self.inertia = Inertia(loaded, self.mass, TIME_STEP)
        self.solver = newton(self.inertia, self.rest)
        self.velocity = np.broadcast_to(velocity, self.rest.shape)

    def step(self) -> None:
        start = self.solver.position
        self.inertia.predicted = start + TIME_STEP * self.velocity
        self.solver.step(start)
        self.velocity = (self.solver.position - start) / TIME_STEP

    def energy(self) -> float:
        """Kinetic and elastic, in joule."""
        elastic = self.elasticity.evaluate(self.solver.position).energy
        return 0.5 * float(self.mass @ (self.velocity**2).sum(axis=1)) + elastic

    def momentum(self) -> np.ndarray:
        """Linear momentum [3] in newton seconds."""
        return self.mass @ self.velocity

    @property
    def stop(self) -> float:
        """What the stop test may leave of a node's position in a step: its residual over mass / dt^2, in metres."""
        return 1e-8 * self.inertia.unit_force * TIME_STEP**2 / self.mass.min()


def solid() -> Outcome:
    """Free fall, tumbling and rest of an elastic box."""
    steps = 50
    n = np.arange(steps + 1)
    fall = Flight(np.zeros(3), GRAVITY)
    for _ in range(steps):
        fall.step()
    expected = -GRAVITY * TIME_STEP**2 * steps * (steps + 1) / 2
    drift = np.abs(fall.solver.position - fall.rest - [0, 0, expected]).max()
    stop = fall.stop * steps * (steps + 1) / 2

    generator = np.random.default_rng(0)
    tumble = Flight(np.array([1.0, 0.5, 2.0]), 0.0)
    tumble.velocity = tumble.velocity + generator.normal(0, 2.0, tumble.rest.shape)
    start, energies, lost = tumble.momentum(), [tumble.energy()], 0.0
    for _ in range(steps):
        tumble.step()
        energies.append(tumble.energy())
        lost = max(lost, float(np.abs(tumble.momentum() - start).max()))
    growth = float(np.diff(energies).max() / energies[0])

    still = Flight(np.zeros(3), 0.0)
    for _ in range(steps):
        still.step()
    moved = np.abs(still.solver.position - still.rest).max()
    # Each step may leave the residual of the stop test at each node, as a force over dt.
    impulse = 1e-8 * tumble.inertia.unit_force * TIME_STEP * len(tumble.rest) * steps
    rows = [
        relative("free fall: mean height after 50 steps", expected, _mean_fall(fall), 1e-10, "rounding", "m"),
        at_most(
            "free fall: largest deviation of a node", drift, stop, "stop test: dt^2 / m of its residual, summed", "m"
        ),
        at_most(
            "tumbling: largest change of momentum / momentum",
            lost / np.abs(start).max(),
            impulse / np.abs(start).max(),
            "stop test: its residual at each node and step",
        ),
        at_most("tumbling: largest growth of energy in a step", max(0.0, growth), 1e-12, "rounding; it must not grow"),
        at_most("at rest: largest displacement after 50 steps", moved, 1e-12, "rounding", "m"),
    ]
    picture = Picture(
        "An elastic box tumbling: backward Euler dissipates its vibrations",
        "step",
        "kinetic + elastic energy / start",
        [Curve("computed", n, np.array(energies) / energies[0], "-")],
    )
    return Outcome(rows, {"energy": picture})


def _mean_fall(flight: Flight) -> float:
    return float(flight.mass @ (flight.solver.position - flight.rest)[:, 2] / flight.mass.sum())


PROBLEMS = [
    Problem(
        "solid",
        "An elastic box in flight and at rest",
        "Backward Euler as a minimisation, dt = 0.01 s. It falls by g dt^2 n (n + 1) / 2 without deforming; thrown and"
        " vibrating without gravity it keeps its momentum and loses energy; at rest it stays.",
        solid,
        quick=solid,
    ),
]
