"""What the solver takes for one frame, at its fastest: a learned model whose user wants one frame is compared with it.

Such a user need not solve all frames before. The solver goes from rest to the wanted frame, straight, in a few load
steps, and frame by frame; the fastest counts. It is run in several variants, which trade accuracy for time: looser stop
tests, a longer range of contact, coarser meshes, Newton steps with linearised contact, and nested iteration: a coarse
solution is carried over to the mesh of the dataset and Newton steps correct it there, which the solver may finish.
`cheapest` finds the fastest variant that is as accurate as the model.
Each scene is solved in a process of its own, on one thread and without torch.
"""

from __future__ import annotations

import json
import math
import os
import selectors
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.whole_motions import require_whole_motions
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.display import SceneProgress
from ast_sim.simulate.jobs.pool import Process
from ast_sim.simulate.jobs.recipe import recipe_of
from ast_sim.simulate.jobs.samples import sample_name
from ast_sim.support.errors import ConfigError, SimulationError, counted
from ast_sim.support.progress import ShowProgress

SOLVER_MODULE = "ast_sim.simulate.jobs.fastest_solver_worker"
OUTCOMES, POSITIONS = "outcomes.json", "positions.npz"
MOST_ITERATIONS = 1000
UNMESHED = "could not be meshed"  # with why, of variants that need a coarser mesh where there is none


@dataclass(frozen=True)
class SolverVariant:
    """Settings with which the solver is run, relative to the settings with which it made the dataset.

    Attributes:
        name: what it is called.
        nodes: share of the nodes of the deforming bodies; above 1 a finer mesh.
        dhat: factor of the range of contact.
        tolerance: factor of the stop test, `SolverSettings.force_tolerance`.
        linearised: the number of load steps, each of one Newton step with linearised contact; one more step follows at
            the end. 0: the bundled solver, with barriers and to its stop test.
        newton: the number of Newton steps with linearised contact that follow on the mesh of the dataset, as after a
            model. In them, surfaces have slid as `NewtonSteps.step` supposes.
        finished: the bundled solver then goes on there to its own stop test, as it may after a model. Where bodies
            overlap or an element is turned over, it cannot.
        every_frame: with friction, as the dataset was made: from each of its frames to the next, up to the wanted one.
            Shorter paths end elsewhere. Without friction all paths end at one place, and the fastest counts.
    """

    name: str
    nodes: float = 1.0
    dhat: float = 1.0
    tolerance: float = 1.0
    linearised: int = 0
    newton: int = 0
    finished: bool = False
    every_frame: bool = False


_NESTED = tuple(
    SolverVariant(
        f"{share} nodes, {solution}, {counted(newton, 'Newton step')}",
        nodes=nodes,
        linearised=linearised,
        newton=newton,
    )
    for share, nodes in (("1/2", 0.5), ("1/4", 0.25))
    for solution, linearised in (("own stop test", 0), ("6 linearised steps", 6), ("12 linearised steps", 12))
    for newton in (1, 2, 3)
)
OWN_STOP_TEST = "own stop test"
VARIANTS = (
    SolverVariant(OWN_STOP_TEST),
    SolverVariant("10x looser", tolerance=10),
    SolverVariant("100x looser", tolerance=100),
    SolverVariant("2x dhat", dhat=2),
    SolverVariant("4x dhat", dhat=4),
    SolverVariant("1/2 nodes", nodes=0.5),
    SolverVariant("1/4 nodes", nodes=0.25),
    SolverVariant("1/2 nodes, 10x looser", nodes=0.5, tolerance=10),
    SolverVariant("1/4 nodes, 10x looser", nodes=0.25, tolerance=10),
    SolverVariant("6 linearised steps", linearised=6),
    SolverVariant("12 linearised steps", linearised=12),
    SolverVariant("1/2 nodes, 6 linearised steps", nodes=0.5, linearised=6),
    SolverVariant("1/2 nodes, 12 linearised steps", nodes=0.5, linearised=12),
    SolverVariant("24 linearised steps", linearised=24),
    *_NESTED,
    SolverVariant("6 linearised steps, then own stop test", linearised=6, finished=True),
    *(
        SolverVariant(
            f"{name} nodes, 6 linearised steps, 1 Newton step, then own stop test", share, 1.0, 1.0, 6, 1, True
        )
        for name, share in (("1/2", 0.5), ("1/4", 0.25))
    ),
    SolverVariant("frame by frame", every_frame=True),
)
FINER = SolverVariant(
    "8 times the nodes", nodes=8.0
)  # not compared with a model: it shows what the mesh of the dataset gets wrong
STARTS = (1, 2, 4, 0)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What one variant gave in one scene, of its cheapest start.

    Attributes:
        variant: how the solver was run.
        failure: why there is no solution, such as "could not be meshed: ..."; empty if there is one.
        nodes: nodes of the mesh that was solved, obstacles included; of nested iteration, of the coarse one.
        start: the load steps that were planned, 0: one for each frame. A step that did not converge was halved, and
            steps then grew again.
        seconds: processor time of the solution on one thread, with the steps that did not converge, but without meshing
            and setting up. The smallest of all repeats; infinite without a mesh. Nested iteration: with the transfer
            and the Newton steps that follow.
        setup_seconds: processor time in which the solver was set up for the mesh; of nested iteration, for both.
        mesh_seconds: processor time of the meshing; 0 for the mesh of the dataset.
        load_steps, newton_iterations, halvings: how many of them the solution took, on all its meshes.
        position: [N,3] float64, the nodes of the dataset's mesh in metres; None without a solution. A coarser mesh
            gives the displacement of free nodes by linear interpolation; prescribed nodes are where they should be.
        error: root of the mean square of the distances in metres to the dataset's frame, over the free nodes.
        relative_error: `error` over the same root of the displacement of the dataset's frame. It says little where
            hardly anything has moved.
        reaction_error, stress_error: of the force on the driven nodes and of the largest von Mises stress on the mesh
            that was solved (nested iteration: on the dataset's), relative to the force and the stress of the dataset's
            frame; infinite without a solution, or where they are 0 there.
    """

    variant: SolverVariant
    failure: str = ""
    nodes: int = 0
    start: int = 0
    seconds: float = math.inf
    setup_seconds: float = 0.0
    mesh_seconds: float = 0.0
    load_steps: int = 0
    newton_iterations: int = 0
    halvings: int = 0
    position: np.ndarray | None = None
    error: float = math.inf
    relative_error: float = math.inf
    reaction_error: float = math.inf
    stress_error: float = math.inf

    @property
    def errors(self) -> dict[str, float]:
        """The relative errors by quantity."""
        return {"displacement": self.relative_error, "reaction": self.reaction_error, "stress": self.stress_error}

    @property
    def converged(self) -> bool:
        """Whether there is a solution."""
        return not self.failure

    @property
    def whole_seconds(self) -> float:
        """Processor time from the mesh to the solution, as the time of a model's answer counts: with setting up."""
        return self.setup_seconds + self.seconds


@dataclass(frozen=True, eq=False)
class SolverOutcomes:
    """All outcomes of one scene.

    Attributes:
        split, index: which trajectory of the dataset.
        frame: which of its frames.
        displacement: root of the mean square of the displacement in this frame in metres, over the free nodes.
        draw_seconds: processor time in which the scene was drawn and meshed as in the dataset.
        processor: where the times were measured.
        outcomes: one for each variant, in their order.
    """

    split: str
    index: int
    frame: int
    displacement: float
    draw_seconds: float
    processor: str
    outcomes: tuple[Outcome, ...]


def cheapest(outcomes: Iterable[Outcome], error: float) -> Outcome | None:
    """The fastest outcome whose relative error is at most `error`; None if there is none."""
    fit = [outcome for outcome in outcomes if outcome.converged and outcome.relative_error <= error]
    return min(fit, key=lambda outcome: outcome.whole_seconds, default=None)


def deepest_frame(trajectory: Trajectory) -> int:
    """The row of the frame in which the free nodes are displaced most, in the mean square; its number, if the
    trajectory has all frames of its motion."""
    moved = trajectory.position - trajectory.position[0]
    free = ~trajectory.scene.prescribed
    return int(np.square(moved[:, free], dtype=np.float64).sum(axis=(1, 2)).argmax())


def solver_outcomes(
    dataset: str | os.PathLike[str],
    split: str,
    indices: Sequence[int],
    frame_of: Callable[[Trajectory], int] | Sequence[int] = deepest_frame,
    *,
    variants: Sequence[SolverVariant] = VARIANTS,
    starts: Sequence[int] = STARTS,
    repeats: int = 1,
    made_from: str | os.PathLike[str] | None = None,
    most_iterations: int = MOST_ITERATIONS,
    progress: ShowProgress = True,
) -> Iterator[SolverOutcomes]:
    """Solve one frame of each scene with every variant; one scene after another, each in a process of its own.

    Args:
        dataset: a dataset that `generate` made with the bundled solver.
        split, indices: which trajectories.
        frame_of: the number of the frame of each trajectory, from 1: a function of it, or one number for each index.
        variants: how the solver is run.
        starts: in how many load steps each variant is tried; 0: frame by frame. The cheapest that converges counts.
        repeats: how often each is timed. The smallest time counts.
        made_from: where the parts or the specification lie, if the dataset was made of the user's own.
        most_iterations: Newton iterations after which a try is given up.
        progress: as in `generate`.

    Raises:
        ConfigError: the dataset was not made by the bundled solver or from a family with inertia, or there is no such
            frame, or a scene has some frames of its motion only.
        SimulationError: drawing the scene again gives another one, or a process ended before its time.
        DatasetError: the dataset cannot be read, or there is no such trajectory.
    """
    if not starts or min(starts) < 0 or repeats < 1:
        raise ConfigError(f"starts {list(starts)} must be at least 0, and repeats {repeats} at least 1")
    with Dataset(dataset) as data:
        require_whole_motions(data, split)
        recipe = recipe_of(str(dataset), data.info, made_from)
        frames = [_frame(data, split, index, which, frame_of) for which, index in enumerate(indices)]
    request = {
        "dataset": str(Path(dataset).resolve()),
        "recipe": asdict(recipe),
        "variants": [asdict(variant) for variant in variants],
        "starts": list(starts),
        "repeats": repeats,
        "most_iterations": most_iterations,
    }
    tasks = [{**request, "split": split, "index": int(i), "frame": k} for i, k in zip(indices, frames, strict=True)]
    return _all(tasks, progress)


def _frame(
    data: Dataset, split: str, index: int, which: int, frame_of: Callable[[Trajectory], int] | Sequence[int]
) -> int:
    """The wanted frame of a trajectory, after a check; `which` is the place of its index among the indices."""
    if not callable(frame_of) and which >= len(frame_of):
        raise ConfigError(f"{counted(len(frame_of), 'frame is', 'frames are')} too few: give one for each index")
    frame = frame_of(data.load(split, index)) if callable(frame_of) else frame_of[which]
    count = data.num_frames(split, index)
    if not 1 <= frame < count:
        raise ConfigError(f"{data.path}: {sample_name(split, index)} has no frame {frame}: 1 to {count - 1}")
    return int(frame)


def _all(tasks: list[dict[str, Any]], progress: ShowProgress) -> Iterator[SolverOutcomes]:
    with SceneProgress(len(tasks), "scenes", progress) as bar:
        for task in tasks:
            name = sample_name(task["split"], task["index"])
            bar.begin(name)
            outcomes = _one(task, name, bar)
            bar.end(name)
            bar.advance(name)
            yield outcomes


def _one(task: dict[str, Any], name: str, bar: SceneProgress) -> SolverOutcomes:
    """Have a process solve a scene; read what it leaves in a folder."""
    with tempfile.TemporaryDirectory(prefix="ast_sim-") as folder, selectors.DefaultSelector() as selector:
        process = Process(SOLVER_MODULE, folder)
        try:
            process.say(json.dumps(task))
            selector.register(process, selectors.EVENT_READ)
            while not selector.select(timeout=1.0):
                bar.tick()
            (answer, *_) = process.receive()
        finally:
            process.stop()
        if "error" in answer:
            raise SimulationError(f"{name}: {answer['error']}")
        facts = json.loads((Path(folder) / OUTCOMES).read_text(encoding="utf-8"))
        with np.load(Path(folder) / POSITIONS, allow_pickle=False) as file:
            positions = {int(key): file[key] for key in file.files}
    outcomes = (
        Outcome(**{**values, "variant": SolverVariant(**values["variant"]), "position": positions.get(place)})
        for place, values in enumerate(facts.pop("outcomes"))
    )
    return SolverOutcomes(task["split"], task["index"], task["frame"], **facts, outcomes=tuple(outcomes))
