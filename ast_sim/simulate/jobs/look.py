"""A look at the scenes of an assembly before they are solved, and what a dataset of them will cost."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from ast_sim.mechanics.case import SolidCase
from ast_sim.mechanics.permanent_set import set_of_body
from ast_sim.scene import NodeType, Trajectory
from ast_sim.simulate.families import assembly
from ast_sim.simulate.jobs.mesh_error import MeshError, mesh_error
from ast_sim.simulate.jobs.pool import Worker
from ast_sim.simulate.jobs.recipe import checked_recipe
from ast_sim.simulate.jobs.samples import Recipe, draw_sample, load_sample, sample_path
from ast_sim.simulate.own_assembly.assembly_spec import AssemblySpec
from ast_sim.simulate.own_assembly.parameters import told, values_of
from ast_sim.simulate.own_assembly.rest_check import gap_between
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.errors import AstSimError, SimulationError, counted

SCENES = 4
UNLOADED = 0.01  # a force below this share of the largest one is none


@dataclass(frozen=True, eq=False)
class Look:
    """The first scenes of a dataset that is not made yet.

    Attributes:
        unit: unit of length.
        cases: the scenes.
        titles: the drawn values of each scene.
        lines: what a person should check in the first scene.
        mesh_seconds, solve_seconds: processor time that one scene takes.
        status: whether the scene that was solved is complete, or why it is not.
        outcome: the peak force of that scene and its permanent set, as a sentence, if a part yields; else empty.
        mesh_error: of the largest force in that scene, on its mesh; None: it is not known.
        mesh_line: the same as a sentence, or why it is not known.
    """

    unit: str
    cases: list[SolidCase]
    titles: list[str]
    lines: list[str]
    mesh_seconds: float
    solve_seconds: float
    status: str
    outcome: str
    mesh_error: MeshError | None
    mesh_line: str


def look(
    spec: str | os.PathLike[str],
    *,
    seed: int = 0,
    nodes: int | None = None,
    frames: int | None = None,
    solver: str | None = None,
) -> Look:
    """Draw the first scenes of a specification, and solve one of them, on two meshes, to see what it takes and gives.

    Args:
        spec: the specification of an assembly.
        seed, nodes, frames, solver: as for `generate`.

    Raises:
        AstSimError: the specification has a mistake, a scene cannot be made, or the first one cannot be solved.
    """
    recipe = checked_recipe(assembly, "assembly", seed, nodes, frames, solver, None, spec=Path(spec))
    read = read_spec(spec)
    assert recipe.frames is not None
    assembly.check_spec(read, recipe.nodes, recipe.frames)
    began = time.perf_counter()
    cases = [draw_sample(recipe, "train", index).case for index in range(SCENES)]
    mesh_seconds = (time.perf_counter() - began) / SCENES
    titles = [told(read.parameters, values_of(case.attributes)) for case in cases]
    solved, solve_seconds = _solved(recipe)
    status = str(solved.attributes.get("stopped_by", "complete"))
    error = None
    try:
        error = mesh_error(read, cases[0], solved, values_of(cases[0].attributes), recipe.nodes, recipe.solver)
        line = str(error)
    except AstSimError as reason:
        line = f"how far the force of this mesh is off is not known: {reason}"
    lines = list(_lines(read, cases[0]))
    return Look(
        read.unit, cases, titles, lines, mesh_seconds, solve_seconds, status, outcome(read, solved), error, line
    )


def outcome(spec: AssemblySpec, solved: Trajectory) -> str:
    """The peak force of a scene, and the largest displacement of the parts that yield after they are let go."""
    if not spec.yielding:
        return ""
    force = np.asarray(solved.attributes["reaction"])
    peak = f"peak force {force.max():.3g} N"
    if force[-1] > UNLOADED * force.max():
        return f"{peak}; {force[-1]:.3g} N act in the last frame: no permanent set before the parts are let go"
    free = set(solved.scene.body[~solved.scene.prescribed].tolist())
    yielding = [number for number, part in enumerate(spec.parts) if part.hardening and number in free]
    largest = [
        max((set_of_body(solved.scene, body, way, frame).largest for body in yielding), default=0.0)
        for frame, way in enumerate(solved.position - solved.position[0])
    ]
    return f"{peak}, permanent set {largest[-1]:.3g} {spec.unit} of {max(largest):.3g} {spec.unit}"


def _lines(spec: AssemblySpec, case: SolidCase) -> Iterator[str]:
    """What a person should check: the nodes of each part, what stands still and what moves, the gaps."""
    scene = case.scene
    unit = spec.unit
    travel = np.linalg.norm(case.followed()[0].prescribed_position - case.prescribed_position[0], axis=2).max(axis=0)
    for number, part in enumerate(spec.parts):
        nodes = scene.body == number
        held = nodes & scene.prescribed
        moved = held & (travel > 0)
        kind = "rigid" if part.rigid else f"{(nodes & (scene.node_type == NodeType.NORMAL)).sum():,} free"
        still = f", {(held & ~moved).sum():,} stand still" if (held & ~moved).any() else ""
        moves = f", {moved.sum():,} move up to {travel[moved].max():.4g} {unit}" if moved.any() else ""
        yield f"{part.name}: {counted(nodes.sum(), 'node')} ({kind}{still}{moves})"
    for pair in combinations(range(len(spec.parts)), 2):
        names = " and ".join(spec.parts[number].name for number in pair)
        yield f"{names}: {gap_between(case, pair):.4g} {unit} apart"


def _solved(recipe: Recipe) -> tuple[Trajectory, float]:
    """The first scene as a worker solves it, and the processor time that it takes."""
    with tempfile.TemporaryDirectory(prefix="ast_sim-") as folder:
        worker = Worker(Path(folder), recipe)
        try:
            worker.give(("train", 0))
            message = {"progress": 0}
            while "progress" in message:
                message = worker.receive()[-1]
        finally:
            worker.stop()
        if "error" in message:
            raise SimulationError(f"the first scene cannot be solved: {message['error']}")
        trajectory, seconds = load_sample(sample_path(Path(folder), "train", 0))
    trajectory.attributes.update(solve_seconds=seconds["solve_seconds"])
    return trajectory, float(np.sum(seconds["solve_seconds"]))
