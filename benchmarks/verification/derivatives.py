"""Verification of derivatives: gradient and Hessian of every energy against differences, and frame indifference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.inertia import Inertia
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.linear_algebra.sparsity import entry_dofs
from ast_sim.simulate.shapes import mesh
from benchmarks.verification.bodies import box, triangles
from benchmarks.verification.problem import Outcome, Problem, Row, at_most

ROUNDING = float(np.finfo(float).eps)
DIRECTIONS = 6


@dataclass(frozen=True)
class Energy:
    """An energy with its derivatives at a position.

    Attributes:
        name: of the energy.
        value, gradient: functions of positions [N,3], the second giving [N,3].
        hessian: function of positions [N,3] giving a sparse matrix [3N,3N].
        position: [N,3] where they are checked.
        length: metres over which forces change by their own size.
        scale: joule; the largest term of the sums in the energy, whose rounding a difference of energies sees.
        indifferent: whether it depends on the shape alone.
    """

    name: str
    value: object
    gradient: object
    hessian: object
    position: np.ndarray
    length: float
    scale: float
    indifferent: bool = True


def of_potential(name: str, potential, position: np.ndarray, length: float, scale: float, indifferent=True) -> Energy:
    """An `Energy` from what the solver takes as a potential."""

    def hessian(x: np.ndarray) -> scipy.sparse.csr_array:
        rows, columns = entry_dofs(potential.entries())
        values = potential.hessian(potential.evaluate(x))
        upper = scipy.sparse.coo_array((values, (np.minimum(rows, columns), np.maximum(rows, columns)))).tocsr()
        upper.resize((x.size, x.size))
        return upper + scipy.sparse.triu(upper, 1).T

    return Energy(
        name,
        lambda x: potential.evaluate(x).energy,
        lambda x: potential.gradient(potential.evaluate(x))[0],
        hessian,
        position,
        length,
        scale,
        indifferent,
    )


def difference_rows(energy: Energy) -> list[Row]:
    """Central differences along random directions of the energy and of the gradient.

    A step s leaves a truncation of order s^2, which steps s and 2 s together measure, and the rounding of two values,
    eps S / s. The step is where both are about equal; the tolerance is ten times their sum, which a wrong derivative
    leaves as it is.
    """
    gradient, hessian = energy.gradient(energy.position), energy.hessian(energy.position)
    force, stiffness = np.abs(gradient).max(), np.abs(hessian).max()
    generator = np.random.default_rng(3)
    directions = generator.uniform(-1, 1, (DIRECTIONS, *energy.position.shape))

    def row(what: str, function, exact, size: float, unit: float) -> Row:
        step = (6 * ROUNDING * size * energy.length**2) ** (1 / 3)
        errors, truncation = [], 0.0
        for direction in directions:
            near, far = (
                (function(energy.position + s * direction) - function(energy.position - s * direction)) / (2 * s)
                for s in (step, 2 * step)
            )
            errors.append(np.abs(near - exact(direction)).max() / unit)
            truncation = max(truncation, np.abs(far - near).max() / 3 / unit)
        rounding = ROUNDING * size / step
        source = f"10 x (truncation {truncation:.0e} + rounding {rounding:.0e}) of differences of step {step:.0e} m"
        label = f"{energy.name}: {what}, relative to its largest entry"
        return at_most(label, max(errors), 10 * (truncation + rounding), source)

    def flat_gradient(x: np.ndarray) -> np.ndarray:
        return energy.gradient(x).ravel()

    return [
        row("gradient", energy.value, lambda d: np.vdot(gradient, d), energy.scale / force, force),
        row("Hessian", flat_gradient, lambda d: hessian @ d.ravel(), force / stiffness, stiffness),
    ]


def indifference_rows(energy: Energy) -> list[Row]:
    """A rotation and a shift leave the energy as it is and rotate the forces."""
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    extent = np.linalg.norm(np.ptp(energy.position, axis=0))
    moved = energy.position @ rotation.T + extent * np.array([0.3, -0.2, 0.1])
    gradient = energy.gradient(energy.position)
    force = np.abs(gradient).max()
    # Positions of size `extent` are rounded to eps extent; forces change by their own size over `length`.
    tolerance = 100 * ROUNDING * extent / energy.length
    change = abs(energy.value(moved) - energy.value(energy.position)) / energy.scale
    turned = np.abs(energy.gradient(moved) - gradient @ rotation.T).max() / force
    source = f"100 roundings of the positions: eps x extent / length of the forces = {tolerance / 100:.0e}"
    return [
        at_most(f"{energy.name}: energy after a rotation", change, tolerance, source),
        at_most(f"{energy.name}: forces after a rotation, turned back", turned, tolerance, source),
    ]


def solid_energies() -> list[Energy]:
    """Elasticity, inertia, the barrier and friction on small meshes far from rest."""
    size, cells = (1.0, 0.8, 0.6), (3, 3, 3)
    rest, elements = box(size, cells, jitter=0.25)
    position = rest + np.random.default_rng(1).uniform(-0.06, 0.06, rest.shape)
    elasticity = Elasticity(rest, elements, NeoHookean(1e6, 0.4))
    scale = 1e6 * elasticity.volume.sum()
    inertia = Inertia(elasticity, elasticity.lumped_volume() * 1e3, 1e-2)
    inertia.predicted = rest
    return [
        of_potential("Ciarlet elasticity", elasticity, position, 0.1, scale),
        of_potential("inertia with elasticity", inertia, position, 0.1, scale, indifferent=False),
        *contact_energies(),
    ]


def contact_energies() -> list[Energy]:
    """The barrier between a turned block and a plate, with face, edge and vertex contacts; with and without friction.

    Friction acts with the normal forces and tangents of where it was lagged, after a slip of about its sticking slip.
    """
    dhat, stiffness = 1e-3, 1e6
    plate, plate_elements = mesh.plate((0.4, 0.3, 0.03), (8, 6, 2), np.zeros((0, 3)))
    block, block_elements = mesh.block((0.05, 0.06, 0.04), 3)
    block = block @ np.array([[0.995, 0.0998, 0.0], [-0.0998, 0.995, 0.0], [0.0, 0.0, 1.0]])
    block = block + [0.013, 0.021, 0.015 + 0.4 * dhat - block[:, 2].min()]
    rest = np.concatenate([plate, block])
    elements = np.concatenate([plate_elements, block_elements + len(plate)])
    body = np.repeat([0, 1], [len(plate), len(block)])

    def energy(name: str, friction: float) -> Energy:
        contact = Contact(rest, triangles(rest, elements), body, ContactSettings(dhat, stiffness, friction))

        def at(x: np.ndarray):
            contact.collision_free_fraction(x, x)
            return contact.at(x)

        position = rest
        if friction:
            contact.lag_friction(at(rest), rest)
            position = rest + np.where(body == 1, 0.04 * dhat, 0)[:, None] * [1.0, 0.5, 0.0]

        def hessian(x: np.ndarray) -> scipy.sparse.csr_array:
            rows, columns, values = at(x).hessian()
            return scipy.sparse.csr_array((values, (rows, columns)), shape=(x.size, x.size))

        length = 0.1 * dhat if not friction else 0.05 * dhat
        scale = at(position).energy()
        return Energy(
            name, lambda x: at(x).energy(), lambda x: at(x).gradient(), hessian, position, length, scale, not friction
        )

    return [energy("barrier", 0.0), energy("barrier with friction", 0.5)]


def derivatives() -> Outcome:
    """Rows of every energy."""
    return Outcome([row for energy in solid_energies() for row in difference_rows(energy)])


def indifference() -> Outcome:
    """Rows of every energy that depends on the shape alone."""
    return Outcome([row for energy in solid_energies() if energy.indifferent for row in indifference_rows(energy)])


PROBLEMS = [
    Problem(
        "derivatives",
        "Gradients and Hessians against differences",
        "Every energy that the solver minimises, far from rest, along random directions: the gradient against central"
        " differences of the energy, the Hessian against central differences of the gradient.",
        derivatives,
        quick=derivatives,
    ),
    Problem(
        "indifference",
        "Frame indifference",
        "psi(R x + t) = psi(x), and the forces turn with R, for a random rotation R and a shift t of the size of the"
        " body.",
        indifference,
        quick=indifference,
    ),
]
