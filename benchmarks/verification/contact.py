"""Verification of contact: a patch test across surfaces that do not match, and real cases: balances and refinement."""

from __future__ import annotations

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.contact_and_friction import Contact, ContactSettings
from ast_sim.mechanics.elements.elasticity import Elasticity
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.solid_frames import quasi_static
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.scene import NodeType, Scene
from ast_sim.simulate.shapes import mesh
from benchmarks.verification.bodies import Rollers, box, cauchy, newton, nodal_areas, sheet, triangles
from benchmarks.verification.problem import (
    Curve,
    Outcome,
    Picture,
    Problem,
    Row,
    at_most,
    more_than,
    observed_order,
    relative,
)

YOUNG, POISSON = 1e6, 0.3
MATERIAL = NeoHookean(YOUNG, POISSON)
MU, LAMBDA = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))  # of the closed forms


SIZE, SHORTENING = (1.0, 1.0, 0.5), 0.2  # of each of two stacked blocks, and of both together, in metres


class StackedBlocks:
    """Two blocks between smooth walls, pressed on each other so that both are in uniaxial strain.

    Args:
        cells: of the lower and of the upper block along a side.
        dhat: distance in metres from which contact acts; the blocks start 2 dhat apart.

    Attributes:
        below, above: [N] the nodes of the surfaces that face each other.
        sides: [N,3] the components that the walls hold.
        solver: at equilibrium after `SHORTENING`.
    """

    def __init__(self, cells: tuple[int, int], dhat: float) -> None:
        gap = 2 * dhat
        (lower, lower_elements), (upper, upper_elements) = (
            box(SIZE, (n, n, max(2, n // 2)), jitter=0.25, seed=n) for n in cells
        )
        self.rest = rest = np.concatenate([lower, upper + [0, 0, SIZE[2] + gap]])
        elements = np.concatenate([lower_elements, upper_elements + len(lower)])
        self.body = np.repeat([0, 1], [len(lower), len(upper)])
        self.sides = np.zeros(rest.shape, bool)
        self.sides[:, :2] = (rest[:, :2] < 1e-9) | (rest[:, :2] > 1 - 1e-9)
        self.bottom, self.top = rest[:, 2] < 1e-9, rest[:, 2] > 2 * SIZE[2] + gap - 1e-9
        self.below, self.above = (np.abs(rest[:, 2] - height) < 1e-9 for height in (SIZE[2], SIZE[2] + gap))
        self.elasticity = Elasticity(rest, elements, MATERIAL)
        self.potential = Rollers(self.elasticity, self.sides, rest, YOUNG / max(cells))
        self.faces = triangles(rest, elements)
        self.contact = Contact(rest, self.faces, self.body, ContactSettings(dhat, YOUNG))
        self.solver = newton(self.potential, rest, self.bottom | self.top, self.contact, tolerance=1e-8)
        for share in (0.25, 0.5, 0.75, 1.0):
            self.solver.step(rest - np.where(self.top, share * SHORTENING, 0)[:, None] * [0, 0, 1])
        self.position = self.potential.seen(self.solver.position)

    def stretch(self) -> float:
        """Of both blocks, in the mean."""
        before, after = (z[self.above].mean() - z[self.below].mean() for z in (self.rest[:, 2], self.position[:, 2]))
        return 2 * SIZE[2] - SHORTENING + float(before - after)

    def contact_pressure(self, forces: np.ndarray) -> np.ndarray:
        """Contact force over area of each node inside the surfaces that face each other."""
        facing = self.below | self.above
        inside = facing & ~self.sides.any(axis=1)
        return np.abs(forces[inside, 2]) / nodal_areas(self.rest, self.faces, facing)[inside]


def stacked_rows(cells: tuple[int, int], dhat: float) -> list[Row]:
    """The blocks against uniaxial strain in closed form."""
    blocks = StackedBlocks(cells, dhat)
    stretch, reactions = blocks.stretch(), blocks.solver.reactions()[:, 2]
    pressure = -(MU + LAMBDA / 2) * (stretch**2 - 1) / stretch
    lateral = -LAMBDA / 2 * (stretch**2 - 1) / stretch
    stress = cauchy(blocks.elasticity, blocks.position)
    contact_force = -blocks.solver.state.contact.gradient()
    # Where the barrier's nodal weights differ from the areas of the nodes, their gaps differ, by less than dhat in
    # all. A surface uneven by dhat over one cell h has the strain dhat / h: of the pressure that is M dhat / (h p).
    modulus = LAMBDA + 2 * MU
    uneven = modulus * dhat * max(cells) / pressure
    source = f"surface uneven by dhat over a cell: M dhat / (h p) = {uneven:.1e}"
    deviations = {
        "sigma_zz, largest deviation of an element / p": stress[2, 2] / -pressure - 1,
        "sigma_xx, largest deviation of an element / p": (stress[0, 0] + lateral) / pressure,
        "contact force / nodal area, largest deviation inside / p": blocks.contact_pressure(contact_force) / pressure
        - 1,
    }
    name = f"{cells[0]} on {cells[1]} cells, dhat = {dhat:g}"
    bottom, top = reactions[blocks.bottom].sum(), reactions[blocks.top].sum()
    return [
        relative(
            f"{name}: pressure on the top, as in uniaxial strain",
            pressure,
            abs(top),
            modulus * dhat / (2 * SIZE[2] * pressure),
            "the mean gap is known to a share of dhat: M dhat / (height p)",
            "Pa",
        ),
        *(
            at_most(f"{name}: {what}", np.abs(deviation).max(), uneven, source)
            for what, deviation in deviations.items()
        ),
        at_most(
            f"{name}: contact forces on the two blocks, sum / force",
            np.linalg.norm(contact_force.sum(axis=0)) / np.abs(contact_force[blocks.body == 1, 2].sum()),
            1e-12,
            "rounding of sums over a thousand pairs",
        ),
        relative(
            f"{name}: force on the bottom / force on the top",
            1.0,
            abs(bottom / top),
            1e-6,
            "stop test: residuals 1e-8 of an element's force, over 1e2 nodes",
        ),
        more_than(
            f"{name}: smallest gap / dhat",
            blocks.contact.gap(blocks.solver.position) / dhat,
            0.0,
            "surfaces never touch",
        ),
    ]


def contact_patch(distances: tuple[float, ...]) -> Outcome:
    """Meshes that do not match, and dhat halved."""
    return Outcome(
        [row for dhat in distances for row in stacked_rows((4, 3), dhat)],
        remarks=[
            "The barrier transmits a uniform pressure across meshes that do not match: what deviates falls with dhat."
        ],
    )


def crush_case(friction: float, frames: int) -> SolidCase:
    """A soft ball held at its top, pressed into a stiffer block a third of its height deep and a little sideways.

    It goes down in `frames` frames and comes back in as many.
    """
    dhat, radius, depth = 1e-3, 0.1, 0.2
    block, block_elements = box((0.4, 0.4, depth), (6, 6, 3), jitter=0.2)
    ball, ball_elements = mesh.ball(radius, 6)
    ball = ball + [0.21, 0.22, depth + radius + 1.5 * dhat]
    rest = np.concatenate([block, ball]).astype(np.float32)
    body = np.repeat(np.arange(2), [len(block), len(ball)]).astype(np.int32)
    held, node_type = rest[:, 2] > depth + 1.6 * radius, np.full(len(rest), NodeType.NORMAL, np.uint8)
    node_type[held | (rest[:, 2] == 0)] = NodeType.HANDLE
    elements = np.concatenate([block_elements, ball_elements + len(block)]).astype(np.int32)
    young = np.repeat([2e6, 1e6], [len(block_elements), len(ball_elements)])
    way = np.concatenate([np.linspace(0, 1, frames + 1), np.linspace(1, 0, frames + 1)[1:]])
    targets = np.repeat(rest[None].astype(float), len(way), axis=0)
    targets[:, held] += way[:, None, None] * np.array([0.01, 0.0, -0.06])
    scene = Scene(rest, elements, node_type, body)
    return SolidCase(scene, targets, NeoHookean(young, 0.4), ContactSettings(dhat, 1e6, friction), "element")


def balances(frames: int, coefficients: tuple[float, ...]) -> Outcome:
    """What must balance in every frame, with friction of these coefficients."""
    rows, curves = [], []
    for friction in coefficients:
        case = crush_case(friction, frames)
        record = quasi_static(case).attributes
        name = f"friction {friction:g}"
        prescribed = int(case.scene.prescribed.sum())
        stop = SolverSettings().force_tolerance * (case.scene.num_nodes - prescribed) / prescribed
        rows += [
            more_than(f"{name}: frames solved", len(record["gap"]), 2 * frames, "all of them"),
            at_most(
                f"{name}: sum of all reactions / sum of their magnitudes, worst frame",
                record["max_imbalance"],
                stop,
                f"stop test: residuals of 1e-4 of an element's force at each free node: {stop:.0e}",
            ),
            at_most(
                f"{name}: work - change of stored energy - friction, over the largest energy, worst frame",
                record["work_balance"],
                1 / frames**2,
                f"trapezoidal rule over {frames} frames of a force like d^m: m (m + 1) / 12 / {frames}^2, m <= 3",
            ),
            at_most(f"{name}: largest residual / stop test", record["max_residual"], 1.0, "the stop test"),
            more_than(f"{name}: smallest det F", record["min_jacobian"], 0.0, "no element is inverted"),
            more_than(f"{name}: smallest gap / dhat", record["min_gap"] / case.contact.dhat, 0.0, "surfaces are apart"),
        ]
        frame = np.arange(len(record["work"]))
        stored = np.add(record["elastic_energy"], record["contact_energy"]) + np.array(record["dissipation"])
        curves += [
            Curve(f"work, friction {friction:g}", frame, np.array(record["work"]), "o"),
            Curve(f"stored + dissipated, friction {friction:g}", frame, stored, "-"),
        ]
    picture = Picture("A ball squeezed and released: work and energy", "frame", "joule", curves)
    return Outcome(rows, {"energy": picture})


def indentation_force(cells: int, dhat: float) -> float:
    """Force in newton that presses a rigid ball 0.02 deep into a block of 0.3 x 0.3 x 0.15 with `cells` along a side.

    The radius of the contact is about a quarter of the side, so that even the coarsest mesh has cells inside it.
    """
    size, radius, depth = (0.3, 0.3, 0.15), 0.3, 0.02
    block, elements = box(size, (cells, cells, cells // 2))
    cap, cap_faces = sheet(0.24, 2 * cells)
    cap[:, :2] -= 0.12
    cap[:, 2] = radius - np.sqrt(radius**2 - (cap[:, :2] ** 2).sum(axis=1))
    rest = np.concatenate([block, cap + [0.15, 0.15, size[2] + 2 * dhat]])
    body = np.repeat([0, 1], [len(block), len(cap)])
    faces = np.concatenate([triangles(block, elements), cap_faces + len(block)])
    contact = Contact(rest, faces, body, ContactSettings(dhat, YOUNG))
    bottom = (rest[:, 2] == 0) & (body == 0)
    solver = newton(Elasticity(rest, elements, MATERIAL), rest, bottom | (body == 1), contact, 1e-6)
    for share in (0.5, 1.0):
        solver.step(rest - np.where(body == 1, share * (depth + 2 * dhat), 0)[:, None] * [0, 0, 1])
    return float(solver.state.contact.gradient()[body == 0, 2].sum())


def refinement(cells: list[int]) -> Outcome:
    """The force under h/2, with dhat fixed, and under dhat/2, with h fixed."""
    distances = [4e-3, 2e-3, 1e-3, 5e-4]
    by_size = [indentation_force(n, distances[1]) for n in cells]
    by_distance = [indentation_force(cells[0], dhat) for dhat in distances]
    order_h, limit_h = observed_order([1 / n for n in cells], by_size)
    order_d, limit_d = observed_order(distances, by_distance)
    rows = [
        more_than(
            "h / 2: observed order",
            order_h,
            1 - 0.25,
            "h^2 inside, h at the edge of the contact, which no mesh line follows; a quarter for the coarsest mesh",
        ),
        relative(
            "dhat / 2: observed order", 1.0, order_d, 0.25, "surfaces stand about dhat apart: the error is linear in it"
        ),
    ]
    picture = Picture(
        "Force on a ball pressed into a block",
        "h or dhat, over the coarsest",
        "force / limit",
        [
            Curve(
                f"h, dhat = {1e3 * distances[1]:g} mm", cells[0] / np.array(cells), np.array(by_size) / limit_h, "o-"
            ),
            Curve(
                f"dhat, h = {300 / cells[0]:g} mm",
                np.array(distances) / distances[0],
                np.array(by_distance) / limit_d,
                "s-",
            ),
        ],
    )
    remarks = [
        "Force with "
        + ", ".join(f"{n} cells {force:.1f} N" for n, force in zip(cells, by_size, strict=True))
        + f" (limit {limit_h:.1f}); with "
        + ", ".join(f"dhat {1e3 * d:g} mm {force:.1f} N" for d, force in zip(distances, by_distance, strict=True))
        + f" (limit {limit_d:.1f})."
    ]
    return Outcome(rows, {"force": picture}, remarks)


PROBLEMS = [
    Problem(
        "contact_patch",
        "Contact patch test",
        "Two blocks with meshes that do not match, sides on rollers, pressed on each other to 80 % of their height:"
        " uniaxial strain. With the stretch l (from the travel and the gap that is left):"
        " sigma_zz = (mu + lambda/2) (l^2 - 1) / l, sigma_xx = lambda/2 (l^2 - 1) / l in both blocks, and a uniform"
        " contact pressure.",
        lambda: contact_patch((2e-3, 1e-3, 5e-4)),
        quick=lambda: contact_patch((1e-3,)),
    ),
    Problem(
        "balances",
        "Balances of a contact case",
        "A soft ball, held at its top, pressed into a stiffer block by a third of its height, and released, solved as a"
        " sample of a dataset is: in every frame reactions sum to zero, work equals stored energy and friction loss,"
        " no element is inverted, no surfaces touch.",
        lambda: balances(12, (0.0, 0.3)),
        quick=lambda: balances(6, (0.3,)),
    ),
    Problem(
        "refinement",
        "Refinement in h and dhat",
        "A rigid ball pressed into a block: the force under refinement of the mesh and of the contact distance.",
        lambda: refinement([6, 12, 24]),
        quick=None,
    ),
]
