"""Verification of second-order elements where linear ones fail: thin strips, the arm of the snap hook of our own
example, rubber, Cook's membrane; and their cost.

All loads are small, so that linear theory and CalculiX's small strains hold. CalculiX's C3D10 has the same shape
functions and points; up to Poisson's ratio 0.476 it is the same element.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np

from ast_sim.element_topology import LOCAL_FACES, MIDDLES
from ast_sim.mechanics.elements.neo_hookean import NeoHookean
from ast_sim.mechanics.elements.second_order import elastic_body
from ast_sim.simulate.own_assembly.parameters import completed
from ast_sim.simulate.own_assembly.part_mesh import part_meshes
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.shapes.mesh import hexahedral_grid, second_order
from benchmarks.verification import ccx
from benchmarks.verification.bodies import DeadLoad, Rollers, newton
from benchmarks.verification.problem import Outcome, Problem, Row, relative

Conditions = Callable[[np.ndarray, np.ndarray], ccx.Problem]  # from positions [N,3] and elements
ELEMENTS = ("linear", "second-order", "C3D10", "C3D20R")  # the first two are ours
STRIP = (60.0, 4.0, 1.0)
DEFLECTION = 0.01
HOOK = Path(__file__).resolve().parents[2] / "examples/snap_hook/SPEC.toml"
PAD_SIDE, PAD_THICKNESS, PAD_STRAIN = 10.0, 1.0, 1e-3
COOK_LOAD = 1e-4  # of the usual one


def mesh_of(kind: str, cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A grid of cells of side 1 in elements of that kind: positions [N,3], elements."""
    if kind == "C3D20R":
        return ccx.hexahedra(cells)
    grid, elements = hexahedral_grid(cells)
    return (grid.astype(float), elements) if kind == "linear" else second_order(grid.astype(float), elements)


def solved(kind: str, problem: ccx.Problem) -> tuple[np.ndarray, np.ndarray]:
    """The displacements [N,3] and the reactions [N,3] where components are held."""
    if kind.startswith("C3D"):
        return ccx.by_calculix(problem)
    rest, elastic = problem.rest, NeoHookean(problem.young, problem.poisson)
    body = elastic_body(rest, problem.elements, elastic)
    rollers = Rollers(body, problem.held, rest + problem.moved, problem.young)
    solver = newton(DeadLoad(rollers, problem.force), rest, tolerance=1e-8)
    solver.step(rest)
    position = rollers.seen(solver.position)
    return position - rest, rollers.reaction(rollers.evaluate(position))


def at(values: np.ndarray, where: float) -> np.ndarray:
    return np.isclose(values, where, atol=1e-9)


def strip_force(kind: str, layers: int) -> float:
    """Force that holds the tip of the strip deflected, with `layers` elements over its thickness of 1."""
    cells = (30, 2, layers)
    grid, elements = mesh_of(kind, cells)
    rest = grid * np.divide(STRIP, cells)
    held, tip = np.zeros(rest.shape, bool), at(rest[:, 0], STRIP[0])
    held[at(rest[:, 0], 0)], held[tip, 2] = True, True
    moved = np.where(held & tip[:, None], DEFLECTION, 0.0)
    problem = ccx.Problem(rest, elements, 1e6, 0.3, held, moved, np.zeros_like(rest))
    return float(solved(kind, problem)[1][tip, 2].sum())


def strip() -> Outcome:
    length, width, thickness = STRIP
    shear = 10 * 1.3 / (12 + 11 * 0.3) * 1e6 / 2.6 * width * thickness
    beam = DEFLECTION / (length**3 / (3 * 1e6 * width * thickness**3 / 12) + length / shear)
    layers = (1, 2, 4)
    forces = {kind: [strip_force(kind, n) for n in layers] for kind in ELEMENTS[:3]}
    rows = [
        relative(f"second-order, {n} over the thickness: force", beam, force, 0.1, "the limit of this page: 10 %", "N")
        for n, force in zip(layers, forces["second-order"], strict=True)
    ]
    rows += same_as_calculix(layers, forces["second-order"], forces["C3D10"], "over the thickness")
    return Outcome(rows, {}, [table("over the thickness", layers, {k: np.divide(f, beam) for k, f in forces.items()})])


def same_as_calculix(sizes, ours, theirs, what: str) -> list[Row]:
    source = "the same element; strains of 1e-3 are not quite linear"
    pairs = zip(sizes, ours, theirs, strict=True)
    return [relative(f"second-order against C3D10, {n} {what}", b, a, 2e-3, source) for n, a, b in pairs]


def table(what: str, sizes: tuple, shares: dict[str, np.ndarray]) -> str:
    """Figures of all elements, relative to the expected one, as a table of the page."""
    head = ["elements", *(f"{n} {what}" for n in sizes)]
    lines = [head, ["---", *["---:"] * len(sizes)]]
    lines += [[kind, *(f"{share:.3f}" for share in values)] for kind, values in shares.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def hook_force(kind: str, factor: float) -> float:
    """Force in newton that holds the end of the hook's arm deflected, with elements `factor` times as long as in the
    example."""
    spec = read_spec(HOOK)
    middle = completed(spec.parameters, {})
    arm = next(part for part in part_meshes(spec, middle, factor) if part.name.startswith("hook"))
    rest = arm.position
    held, end = np.zeros(rest.shape, bool), at(rest[:, 0], rest[:, 0].max())
    held[at(rest[:, 0], 0)], held[end, 1] = True, True
    moved = np.where(held & end[:, None], -DEFLECTION, 0.0)
    young, poisson = middle["hook.young"], middle["hook.poisson"]
    problem = ccx.Problem(rest, arm.cells, young, poisson, held, moved, np.zeros_like(rest))
    return float(-1e-6 * solved(kind, problem)[1][end, 1].sum())  # pascal times square millimetres


def hook() -> Outcome:
    factors, sizes = (1.0, 0.5, 0.25), (2, 1, 0.5)
    forces = {kind: [hook_force(kind, factor) for factor in factors] for kind in ("second-order", "C3D10")}
    source = "the limit of examples: the mesh's own error is at most 5 %"
    limit = forces["C3D10"][-1]
    rows = [
        relative(f"second-order, elements of {size} mm: force, C3D10 of 0.5 mm", limit, force, 0.05, source, "N")
        for size, force in zip(sizes[:2], forces["second-order"], strict=False)
    ]
    return Outcome(rows + same_as_calculix(sizes, forces["second-order"], forces["C3D10"], "mm: force"))


def pad_stress(kind: str, cells: tuple[int, int, int], poisson: float = 0.499) -> float:
    """Mean pressure on a bonded square pad over its strain, in units of Young's modulus; an eighth of it is solved."""
    grid, elements = mesh_of(kind, cells)
    rest = grid * np.divide((PAD_SIDE / 2, PAD_SIDE / 2, PAD_THICKNESS / 2), cells)
    held, top = at(rest, 0), at(rest[:, 2], PAD_THICKNESS / 2)
    held[top] = True
    moved = np.zeros_like(rest)
    moved[top, 2] = -PAD_STRAIN * PAD_THICKNESS / 2
    problem = ccx.Problem(rest, elements, 1.0, poisson, held, moved, np.zeros_like(rest))
    return float(-solved(kind, problem)[1][top, 2].sum() / (PAD_SIDE / 2) ** 2 / PAD_STRAIN)


def shape_factor_modulus(poisson: float) -> float:
    """E + 6.748 G S^2 of a square of the shape factor S = side / (4 thickness), and the bulk modulus in series."""
    shape = PAD_SIDE / (4 * PAD_THICKNESS)
    incompressible = 1 + 6.748 / 3 * shape**2
    return 1 / (1 / incompressible + 3 * (1 - 2 * poisson))


def rubber() -> Outcome:
    expected, meshes = shape_factor_modulus(0.499), ((6, 6, 2), (10, 10, 3))
    names = tuple("x".join(map(str, cells)) for cells in meshes)
    moduli = {kind: [pad_stress(kind, cells) for cells in meshes] for kind in ELEMENTS}
    rows = []
    for name, ours, theirs in zip(names, moduli["second-order"], moduli["C3D20R"], strict=True):
        limit = "the limit of this page: 10 %"
        rows.append(relative(f"second-order, {name} cells: modulus / E, formula", expected, ours, 0.1, limit))
        rows.append(relative(f"second-order, {name} cells: modulus / E, C3D20R", theirs, ours, 0.1, limit))
    shares = {kind: np.divide(values, expected) for kind, values in moduli.items()}
    return Outcome(rows, {}, [table("cells", names, shares)])


def cook_tip(kind: str, cells: int, poisson: float, plane_strain: bool) -> float:
    """Vertical displacement of the middle (in plane strain: of the upper end) of the right edge, of the whole load."""
    grid, elements = mesh_of(kind, (cells, cells, 1))
    x, share = 48 * grid[:, 0] / cells, grid[:, 1] / cells
    low, high = 44 * x / 48, 44 + 16 * x / 48
    rest = np.stack([x, low + share * (high - low), grid[:, 2]], axis=1)
    held = np.zeros(rest.shape, bool)
    held[at(x, 0), :2] = True
    held[at(rest[:, 2], 0) | plane_strain, 2] = True
    young, load = (250.0, 100.0) if plane_strain else (1.0, 1.0)
    weights = edge_weights(kind, elements, at(x, 48), rest)
    force = np.zeros_like(rest)
    force[:, 1] = COOK_LOAD * load * weights
    problem = ccx.Problem(rest, elements, young, poisson, held, np.zeros_like(rest), force)
    displacement = solved(kind, problem)[0]
    node = at(x, 48) & at(share, 1.0 if plane_strain else 0.5) & at(rest[:, 2], 0)
    return float(displacement[node, 1].item() / COOK_LOAD)


def edge_weights(kind: str, elements: np.ndarray, on_face: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """[N] shares of the nodes of a flat face in a uniform load on it."""
    weights = np.zeros(len(rest))
    if kind == "C3D20R":  # -1/12 at the corners of a square, 1/3 at the middles of its sides
        for nodes, share in ((elements[:, :8], -1 / 12), (elements[:, 8:], 1 / 3)):
            whole = on_face[elements[:, :8]].sum(axis=1) == 4
            chosen = nodes[whole][on_face[nodes[whole]]]
            np.add.at(weights, chosen, share)
        return weights / weights.sum()
    for face in LOCAL_FACES:
        rows = elements[on_face[elements[:, list(face)]].all(axis=1)]
        corners = rest[rows[:, list(face)]]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        middles = [4 + number for number, ends in enumerate(MIDDLES) if set(ends) <= set(face)]
        for node in face if kind == "linear" else middles:
            np.add.at(weights, rows[:, node], area)
    return weights / weights.sum()


def cook() -> Outcome:
    sizes, rows, remarks = (4, 8, 16), [], []
    rises = {kind: [cook_tip(kind, n, 1 / 3, False) for n in sizes] for kind in ELEMENTS}
    source = "the limit of this page: 10 %"
    rows.append(relative("nu = 1/3, second-order, 4 cells: rise", 23.96, rises["second-order"][0], 0.1, source))
    source = "tolerance of 4 cells / 4^1.5: the stress is singular at a clamped corner"
    rows.append(relative("nu = 1/3, second-order, 16 cells: rise", 23.96, rises["second-order"][-1], 0.0125, source))
    rows += same_as_calculix(sizes, rises["second-order"], rises["C3D10"], "cells")
    remarks.append("Plane stress, nu = 1/3, relative to 23.96:\n\n" + table("cells", sizes, divided(rises, 23.96)))
    rubber = {kind: [cook_tip(kind, n, 0.4999, True) for n in sizes] for kind in ELEMENTS}
    limit = cook_tip("C3D20R", 32, 0.4999, True)
    source = "the limit of this page: 10 %"
    for n, ours in zip(sizes[1:], rubber["second-order"][1:], strict=True):
        rows.append(relative(f"nu = 0.4999, second-order, {n} cells: rise, C3D20R on 32", limit, ours, 0.1, source))
    remarks.append(
        "Plane strain, nu = 0.4999, relative to C3D20R on 32 cells:\n\n" + table("cells", sizes, divided(rubber, limit))
    )
    return Outcome(rows, {}, remarks)


def divided(figures: dict[str, list[float]], by: float) -> dict[str, np.ndarray]:
    return {kind: np.divide(values, by) for kind, values in figures.items()}


def step_seconds(kind: str, cells: tuple[int, int, int]) -> tuple[int, float]:
    """The nodes of a block that is pressed by 5 %, and the processor time of a Newton iteration."""
    grid, elements = mesh_of(kind, cells)
    rest = grid / np.array(cells)
    body = elastic_body(rest, elements, NeoHookean(1e6, 0.4))
    solver = newton(body, rest, at(rest[:, 2], 0) | at(rest[:, 2], 1), tolerance=1e-6)
    target = rest - 0.05 * rest * [0, 0, 1]
    began = process_time()
    solver.step(target)
    return len(rest), (process_time() - began) / solver.iterations


def cost() -> Outcome:
    rows, lines = [], []
    for n in (4, 6, 8):
        linear, second = [], []
        for _ in range(5):
            nodes, seconds = step_seconds("linear", (2 * n, 2 * n, 2 * n))
            linear.append(seconds)
            same, seconds = step_seconds("second-order", (n, n, n))
            second.append(seconds)
            assert same == nodes
        ratio = float(np.median(second) / np.median(linear))
        what = f"{nodes} nodes: time of an iteration, relative to linear elements (< 2)"
        rows.append(Row(what, None, ratio, ratio, 2.0, "the limit of this page: twice"))
        least, median = ([1e3 * float(of(one)) for one in (linear, second)] for of in (np.min, np.median))
        lines.append(
            f"{nodes} nodes, 5 repeats in turn: linear {least[0]:.0f} ms at least, {median[0]:.0f} in the median;"
            f" second-order {least[1]:.0f} and {median[1]:.0f} ms; ratio of the medians {ratio:.2f}."
        )
    return Outcome(rows, {}, lines)


PROBLEMS = [
    Problem(
        "strip",
        "A thin strip",
        "60 x 4 x 1, nu = 0.3, elements 2 long and wide, clamped at one end; the other end is moved by 1/100 across."
        " The force against Timoshenko's beam with Cowper's k. The table gives all forces relative to it.",
        strip,
        quick=strip,
    ),
    Problem(
        "hook",
        "The arm of a snap hook",
        "The hook of examples/snap_hook, in the middle of its ranges, as gmsh meshes it: elements of 2 mm, as in the"
        " example, and shorter ones, in an arm 1.9 mm thick. It is clamped at its root; the end is moved by 1/100 mm"
        " across, without the slot: CalculiX found no equilibrium of the first step in which nose and slot touch.",
        hook,
        quick=hook,
    ),
    Problem(
        "rubber",
        "A bonded rubber pad",
        "A square pad, 10 x 10 x 1, between two rigid plates, nu = 0.499, pressed by 0.1 %. Pressure over strain"
        " against E + 6.748 G S^2 with the shape factor S = side / (4 thickness) = 2.5 (Gent and Meinecke; Kelly), in"
        " series with the bulk modulus. An eighth is solved; the table has the numbers of its cells, and all moduli"
        " relative to the formula.",
        rubber,
        quick=rubber,
    ),
    Problem(
        "cook",
        "Cook's membrane",
        "A tapered panel (0, 0), (48, 44), (48, 60), (0, 44), clamped on the left, with an even vertical load on the"
        " right. Plane stress with E = 1, nu = 1/3, load 1: the middle of the right edge rises by 23.96 (Cook;"
        " limit of fine meshes). Plane strain with E = 250, nu = 0.4999, load 100: the upper end of that edge, against"
        " C3D20R. A 1e-4 of the loads is applied, and the displacement divided by it. Meshes have n x n x 1 cells.",
        cook,
        quick=cook,
    ),
    Problem(
        "cost",
        "What second-order elements cost",
        "A cube pressed by 5 %: processor time of a Newton iteration on meshes of the same nodes.",
        cost,
        quick=None,
    ),
]
