"""A process that solves one frame of one scene in several variants, and times each.

    python -m ast_sim.simulate.jobs.fastest_solver_worker FOLDER PARENT

It reads one line from its standard input, a task as JSON: `dataset`, `recipe`, `split`, `index`, `frame`, `variants`,
`starts`, `repeats`, `most_iterations` (see `fastest_solver`). It writes the outcomes to FOLDER and answers with a line
of JSON: `done`, or `error`. Like every worker it has one thread, never imports torch, and ends with its parent.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.mechanics.case import Drawn, SolidCase
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.elements.second_order import deforming_body
from ast_sim.mechanics.equilibria import Equilibria
from ast_sim.mechanics.linearised.linearised_contact import CLEARANCE, NewtonSteps
from ast_sim.mechanics.reaction import Reaction
from ast_sim.mechanics.solid_frames import OneFrame, solve_frame
from ast_sim.mechanics.solver import SolverSettings
from ast_sim.scene import Scene
from ast_sim.simulate.families.known_families import family_module
from ast_sim.simulate.jobs.fastest_solver import OUTCOMES, POSITIONS, UNMESHED, Outcome, SolverVariant
from ast_sim.simulate.jobs.samples import Recipe, draw_sample
from ast_sim.simulate.jobs.worker import answers_for
from ast_sim.simulate.shapes.mesh_transfer import transferred
from ast_sim.support.errors import SimulationError
from ast_sim.support.provenance import processor

SAME_PLACE = 1e-6  # largest distance of a node from its place in the dataset, relative to the size of the scene


def main() -> None:
    """Answer one task."""
    folder = Path(sys.argv[1])
    parent = int(sys.argv[2])
    answer = answers_for(parent)
    try:
        facts, positions = outcomes_of(json.loads(sys.stdin.readline()))
        np.savez(folder / POSITIONS, **positions)
        (folder / OUTCOMES).write_text(json.dumps(facts), encoding="utf-8")
        answer({"done": True})
    except SimulationError as error:
        answer({"error": str(error)})
    except Exception as error:
        answer({"error": f"{type(error).__name__}: {error}"})


def outcomes_of(task: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Solve a task: the facts as JSON values, and the positions of outcome i by the name "i"."""
    recipe = Recipe(**task["recipe"])
    with Dataset(task["dataset"]) as dataset:
        scene = dataset.scene(task["split"], task["index"])
        truth = dataset.frames(task["split"], task["index"], task["frame"], task["frame"] + 1)[0][0].astype(np.float64)
    frames = tuple(range(1, task["frame"] + 1)) if recipe.keep is None else recipe.keep[: task["frame"]]
    started = _seconds()
    drawn = draw_sample(recipe, task["split"], task["index"])
    draw_seconds = _seconds() - started
    _require_same(drawn.case.scene, scene)
    solver = VariantSolver(drawn, frames, truth, family_module(recipe.family).SETTINGS, task)
    outcomes = [solver.outcome(SolverVariant(**variant)) for variant in task["variants"]]
    facts = {
        "displacement": solver.displacement,
        "draw_seconds": draw_seconds,
        "processor": processor(),
        "outcomes": [asdict(replace(outcome, position=None)) for outcome in outcomes],
    }
    return facts, {str(i): outcome.position for i, outcome in enumerate(outcomes) if outcome.position is not None}


def _seconds() -> float:
    """Processor time of this process and of the processes that it has started, such as gmsh."""
    return sum(os.times()[:4])


def _require_same(drawn: Scene, stored: Scene) -> None:
    """Raise SimulationError if the scene drawn again is not the one of the dataset."""
    same = drawn.num_nodes == stored.num_nodes and np.array_equal(drawn.elements, stored.elements)
    if same:
        extent = np.ptp(stored.rest_position, axis=0).max()
        same = np.abs(drawn.rest_position - stored.rest_position).max() <= SAME_PLACE * extent
    if not same:
        raise SimulationError(
            "drawing the scene again gives another one than the dataset holds: use the versions of the packages that"
            " the dataset names (`ast-sim info`)"
        )


class VariantSolver:
    """Solves one frame of a drawn scene in one variant after another.

    Args:
        drawn: the scene.
        frames: the numbers of the dataset's frames in the motion of the scene, up to the one to be solved.
        truth: [N,3] float64, the dataset's positions in this frame.
        settings: the tolerances with which the dataset was made.
        limits: `starts`, `repeats` and `most_iterations`.
    """

    def __init__(
        self,
        drawn: Drawn,
        frames: tuple[int, ...],
        truth: np.ndarray,
        settings: SolverSettings,
        limits: dict[str, Any],
    ) -> None:
        self.drawn = drawn
        self.frames = frames
        self.truth = truth
        self.settings = settings
        self.limits = limits
        self.frame = frames[-1]
        self.path_counts = drawn.case.friction > 0
        self.free = ~drawn.case.scene.prescribed
        self.rest = drawn.case.scene.rest_position.astype(np.float64)
        self.displacement = _root_mean_square((truth - self.rest)[self.free])
        self._loads: dict[float, _Loads] = {}
        self._meshes: dict[float, tuple[SolidCase | str, float]] = {1.0: (drawn.case, 0.0)}
        self._solved: dict[SolverVariant, tuple[int, OneFrame]] = {}
        # The libraries are loaded in the first solution; nobody's time should hold that.
        solve_frame(drawn.case, self.frame, settings, most_iterations=1)
        self._linearised(drawn.case, 1)
        self._on_own_mesh(drawn.case, self.rest)

    def outcome(self, variant: SolverVariant) -> Outcome:
        """Mesh and solve with this variant; the cheapest of all starts that converge."""
        if variant.nodes not in self._meshes:
            self._meshes[variant.nodes] = self._meshed(variant.nodes)
        case, mesh_seconds = self._meshes[variant.nodes]
        if not isinstance(case, SolidCase):
            return Outcome(variant, f"{UNMESHED}: {case}", mesh_seconds=mesh_seconds)
        start, first = self._solution(case, variant)
        more = variant.newton or variant.finished
        solved = self._best(lambda: self._continued(case, first, variant)) if more else first
        position = None
        error = np.inf
        load_errors = np.inf, np.inf
        if solved.position is not None:
            own = variant.nodes == 1 or more
            position = solved.position if own else self._on_own_mesh(case, solved.position)
            error = _root_mean_square((position - self.truth)[self.free])
            load_errors = self._load_errors(1.0 if own else variant.nodes, solved.position)
        return Outcome(
            variant,
            solved.failure,
            case.scene.num_nodes,
            start,
            solved.seconds,
            solved.setup_seconds,
            mesh_seconds,
            solved.load_steps,
            solved.newton_iterations,
            solved.halvings,
            position,
            error,
            error / max(self.displacement, np.finfo(float).tiny),
            *load_errors,
        )

    def _load_errors(self, share: float, position: np.ndarray) -> tuple[float, float]:
        """The errors of the force and of the largest stress of positions on the mesh with this share of the nodes,
        relative to the force and the stress of the dataset's frame."""
        true_force, true_stress = self._true_loads
        force, stress = self._loads_on(share).at(position)
        size = float(np.linalg.norm(true_force))
        off = float(np.linalg.norm(force - true_force))
        return off / size if size else np.inf, abs(stress - true_stress) / true_stress if true_stress else np.inf

    @cached_property
    def _true_loads(self) -> tuple[np.ndarray, float]:
        return self._loads_on(1.0).at(self.truth)

    def _loads_on(self, share: float) -> _Loads:
        if share not in self._loads:
            case, _ = self._meshes[share]
            assert isinstance(case, SolidCase)
            self._loads[share] = _Loads(case)
        return self._loads[share]

    def _meshed(self, share: float) -> tuple[SolidCase | str, float]:
        """The scene with that share of the nodes, or why there is none; and the processor time of all tries."""
        started = _seconds()
        try:
            coarser: SolidCase | str = self.drawn.remesh_nearly(share)
        except SimulationError as error:
            coarser = str(error)
        return coarser, _seconds() - started

    def _solution(self, case: SolidCase, variant: SolverVariant) -> tuple[int, OneFrame]:
        """The start and the solution on the mesh of a variant; variants that differ in what follows share it."""
        alone = replace(
            variant, name="", newton=0, finished=False, every_frame=variant.every_frame and self.path_counts
        )
        if alone not in self._solved:
            case = replace(case, contact=replace(case.contact, dhat=variant.dhat * case.contact.dhat))
            settings = replace(self.settings, force_tolerance=variant.tolerance * self.settings.force_tolerance)
            if variant.linearised:
                solved = variant.linearised, self._best(lambda: self._linearised(case, variant.linearised))
            elif alone.every_frame:
                solved = 0, self._best(lambda: self._every_frame(case, settings))
            else:
                solved = self._fastest(case, settings)
            self._solved[alone] = solved
        return self._solved[alone]

    def _best(self, solve: Callable[[], OneFrame]) -> OneFrame:
        """The fastest of all repeats."""
        return min((solve() for _ in range(self.limits["repeats"])), key=lambda one: one.setup_seconds + one.seconds)

    def _fastest(self, case: SolidCase, settings: SolverSettings) -> tuple[int, OneFrame]:
        """The start with the fastest solution, and the solution; without any, the start that failed fastest."""
        best: tuple[int, OneFrame] | None = None
        for start in self.limits["starts"]:
            for _ in range(self.limits["repeats"]):
                # Whoever takes longer than the best so far cannot be the fastest.
                most = best[1].seconds if best is not None and not best[1].failure else np.inf
                first = 1 / start if start else 0.0
                solved = solve_frame(
                    case, self.frame, settings, first, self.limits["most_iterations"], most_seconds=most
                )
                if best is None or (bool(solved.failure), solved.seconds) < (bool(best[1].failure), best[1].seconds):
                    best = start, solved
        assert best is not None
        return best

    def _every_frame(self, case: SolidCase, settings: SolverSettings) -> OneFrame:
        """From each frame of the dataset to the next."""
        most = self.limits["most_iterations"]
        return solve_frame(case.keeping(self.frames), len(self.frames), settings, first=0, most_iterations=most)

    def _linearised(self, case: SolidCase, steps: int) -> OneFrame:
        """`steps` load steps of one Newton step with linearised contact, and one Newton step more."""
        held = case.scene.prescribed[:, None]
        began = process_time()
        position = before = case.prescribed_position[0]
        failure = ""
        try:
            newton = _newton_steps(case)
            setup = process_time() - began
            for share in np.linspace(0, 1, steps + 1)[1:]:
                target = case.on_the_way(self.frame, share)
                before = position
                position = newton.step(np.where(held, target, before), stuck=before)
            position = newton.step(position, stuck=before)
        except SimulationError as error:
            position = None
            failure = str(error)
            setup = 0.0
        return OneFrame(position, failure, process_time() - began - setup, setup, steps, steps + 1, 0)

    def _continued(self, case: SolidCase, solved: OneFrame, variant: SolverVariant) -> OneFrame:
        """A solution, carried over to the mesh of the dataset, and what follows there: Newton steps, and the solver."""
        if solved.position is None:
            return solved
        began = process_time()
        position = None
        failure = ""
        setup = 0.0
        iterations = 0
        try:
            newton = _newton_steps(self.drawn.case)
            equilibria = Equilibria(self.drawn.case, newton, self.settings) if variant.finished else None
            setup = process_time() - began
            position = solved.position if variant.nodes == 1 else self._on_own_mesh(case, solved.position)
            for step in range(variant.newton):
                position = newton.step(position, from_afar=step == 0)
            if equilibria is not None:
                position = equilibria.finish(self.frame, position)
                iterations = equilibria.iterations
        except SimulationError as error:
            position = None
            failure = f"on the mesh of the dataset: {error}"
        return replace(
            solved,
            position=position,
            failure=failure,
            seconds=solved.seconds + process_time() - began - setup,
            setup_seconds=solved.setup_seconds + setup,
            newton_iterations=solved.newton_iterations + variant.newton + iterations,
        )

    def _on_own_mesh(self, case: SolidCase, position: np.ndarray) -> np.ndarray:
        """Positions of the nodes of the dataset's mesh, from the positions of another mesh of the same bodies."""
        scene = case.scene
        rest = scene.rest_position.astype(np.float64)
        result = self.drawn.case.prescribed_position[self.frame].copy()
        body = scene.body[scene.elements[:, 0]]
        for number in np.unique(self.drawn.case.scene.body[self.free]):
            nodes = self.free & (self.drawn.case.scene.body == number)
            elements = scene.elements[body == number]
            result[nodes] = self.rest[nodes] + transferred(rest, elements, position - rest, self.rest[nodes])
        return result


class _Loads:
    """The force on the driven nodes of a case, and its largest von Mises stress."""

    def __init__(self, case: SolidCase) -> None:
        scene = case.scene
        self._reaction = Reaction(
            scene, Driven.of(scene, case.prescribed_position), case.material, case.contact_forces()
        )
        soft = np.flatnonzero(~scene.rigid_elements)
        self._elasticity = deforming_body(scene, soft, case.material)
        self._location = case.stress_location
        rows = scene.deforming(case.stress_location)
        self._rows = rows if case.stress_location == "node" else rows[soft]

    def at(self, position: np.ndarray) -> tuple[np.ndarray, float]:
        """At positions [N,3]: the force [3], and the stress in pascal."""
        stress = self._elasticity.von_mises(self._elasticity.evaluate(position), self._location)
        return self._reaction.of(position), float(stress[self._rows].max())


def _newton_steps(case: SolidCase) -> NewtonSteps:
    """The Newton steps of a case, with one coefficient of friction."""
    return NewtonSteps(case.scene, case.material, CLEARANCE * case.contact.dhat, case.friction)


def _root_mean_square(vectors: np.ndarray) -> float:
    """Root of the mean of the squared lengths of vectors [n,3]."""
    return float(np.sqrt(np.square(vectors).sum(axis=1).mean()))


if __name__ == "__main__":
    main()
