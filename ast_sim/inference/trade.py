"""What an error costs: efforts of runs and variants of the solver on the same scenes, timed in turns on one thread."""

from __future__ import annotations

import math
import os
import shlex
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.dataset.whole_motions import require_whole_motions
from ast_sim.inference.answering import answers
from ast_sim.inference.calibrate import require_new_scenes, require_runs
from ast_sim.inference.effort import Effort, choices, options_of
from ast_sim.inference.evaluation.deepest_frames import deepest_predicted
from ast_sim.inference.evaluation.gaussian_process import PROCESS, process_beside
from ast_sim.inference.predicting.question import Question
from ast_sim.inference.quantities.relative_errors import QUANTITIES, errors_of, judging_fields, moves
from ast_sim.inference.trained_run import Run
from ast_sim.models.simulator import Simulator
from ast_sim.simulate.jobs.fastest_solver import FINER, OWN_STOP_TEST, Outcome, solver_outcomes
from ast_sim.simulate.jobs.recipe import recipe_of
from ast_sim.support.argument_checks import file_name, in_short, require_type, several
from ast_sim.support.disk import write_json
from ast_sim.support.errors import ConfigError, SimulationError
from ast_sim.support.notebook_table import one_line
from ast_sim.support.progress import Progress, ShowProgress
from ast_sim.support.provenance import provenance
from ast_sim.support.toml_settings import required_whole
from ast_sim.trade_figures import Setting, Side, TradeFigures
from ast_sim.view import trade_page
from ast_sim.view.files import make_folder
from ast_sim.view.page import page_name

SCENES = 20
LONGEST = 1e9  # seconds of a solver for a scene: 30 years
MESH_SCENES = 3  # in which the mesh's own error is measured


@dataclass(frozen=True, eq=False)
class Trade:
    """Speed against accuracy of a run, beside the solver. `str` gives the tables at fixed errors.

    Attributes:
        by_quantity: what was measured, by what the errors are of: "displacement", and "reaction" and "stress" where all
            scenes have them.
    """

    by_quantity: Mapping[str, TradeFigures]

    @property
    def figures(self) -> TradeFigures:
        """The figures of the error of the displacement."""
        return self.by_quantity["displacement"]

    def __repr__(self) -> str:
        return one_line("Trade", {"scenes": len(self.figures.scenes), "errors of": ", ".join(self.by_quantity)})

    def __str__(self) -> str:
        return "\n".join(line for figures in self.by_quantity.values() for line in figures.lines())

    def to_json(self) -> dict[str, Any]:
        """All figures, by quantity."""
        return {quantity: figures.to_json() for quantity, figures in self.by_quantity.items()}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all figures as JSON."""
        write_json(file_name(path, "path"), self.to_json())

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write a page: error against seconds, and the tables; a missing folder is made.

        Raises:
            AstSimError: the suffix is neither .html nor .htm, or the file cannot be written.
            MissingExtra: plotly is not installed.
        """
        make_folder(page_name(path).parent)
        trade_page.write(path, list(self.by_quantity.values()), "Speed against accuracy")


def trade(
    run: Run,
    data: str | os.PathLike[str] | Dataset | None = None,
    split: str = "test",
    *,
    beside: Sequence[Run] = (),
    scenes: int = SCENES,
    solver_seconds: float | None = None,
    made_from: str | os.PathLike[str] | None = None,
    command: str = "ast_sim.trade",
    progress: ShowProgress = True,
) -> Trade:
    """Measure what each error costs: by every effort of a run, by the solver in all its variants, by other runs, and by
    a Gaussian process that learns the training scenes of the dataset, where it applies.

    Each answer is of the deepest frame of a scene, alone, on one thread. Times are processor seconds, and count what is
    prepared for a mesh.

    Args:
        data: a dataset, its path or open; by default the one that the run was trained on.
        split, scenes: whose scenes are predicted, and how many, at most: the first ones that move.
        beside: other runs that have learned from the same dataset, such as other models. Each stands in the tables with
            its fastest effort, by the name of its folder.
        solver_seconds: what another program takes for such a scene, to the error of its mesh; our solver is not run.
        made_from: the specification or the parts of your own of which the dataset was made; the solver needs them.
        command, progress: what is recorded as the origin of the figures; as in `generate`.

    Raises:
        ConfigError: the split has trained or chosen the run, none of its scenes moves, or one has some frames only;
            the solver's seconds are not above 0; a run beside has learned from another dataset, or has another's name.
        DatasetError: the dataset cannot be read.
    """
    (scenes,) = required_whole(1, scenes=scenes)
    _require_seconds(solver_seconds, made_from)
    require_type("command", command, str, "a text")
    beside = several("beside", beside, "runs")
    require_runs(run, *beside)
    runs = _by_name([run, *beside])
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with run.open(data) as dataset:
            require_new_scenes(run, dataset, split)
            require_whole_motions(dataset, split)
            if made_from is not None:
                recipe_of(str(dataset.path), dataset.info, made_from)  # a wrong one would leave the solver out
            moving = (index for index in range(dataset.count(split)) if moves(dataset.load(split, index)))
            indices = list(islice(moving, scenes))
            if not indices:
                raise ConfigError(f"{dataset.path}: no scene of the split {split} moves")
            return Trade(
                _measured(runs, _Scenes(dataset, split, indices, made_from), solver_seconds, command, progress)
            )
    finally:
        torch.set_num_threads(threads)


def _require_seconds(stated: float | None, made_from: str | os.PathLike[str] | None) -> None:
    """Raise ConfigError unless the seconds of another program are a number above 0, and stand alone."""
    positive = isinstance(stated, Real) and not isinstance(stated, bool) and 0 < stated <= LONGEST
    if stated is not None and not positive:
        raise ConfigError(
            f"the solver's seconds are {in_short(stated)}; they must be a number above 0, at most {LONGEST:g}"
        )
    if stated is not None and made_from is not None:
        raise ConfigError("made_from is for our solver, which solver_seconds stands for: give one of them")


class _Scenes(NamedTuple):
    """The scenes on which all is measured, and of what they were made."""

    dataset: Dataset
    split: str
    indices: Sequence[int]
    made_from: str | os.PathLike[str] | None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"{self.split}/{index:06d}" for index in self.indices)


def _by_name(runs: Sequence[Run]) -> dict[str, Run]:
    """The runs by the names of their folders or files, after a check."""
    first = runs[0]
    named: dict[str, Run] = {}
    for run in runs:
        if run.folder.origin["data"] != first.folder.origin["data"]:
            raise ConfigError(
                f"{run.path} has learned from another dataset ({Path(run.settings.data).name}) than {first.path}"
                f" ({Path(first.settings.data).name}): only runs of one dataset stand beside each other"
            )
        if run.path.name in (*named, PROCESS):
            other = "a Gaussian process is" if run.path.name == PROCESS else "two runs are"
            raise ConfigError(f"{other} called {run.path.name}: rename the run, so that each has its column")
        named[run.path.name] = run
    return named


def _measured(
    runs: Mapping[str, Run], scenes: _Scenes, stated: float | None, command: str, progress: ShowProgress
) -> dict[str, TradeFigures]:
    """The figures by quantity; the first run is the one beside which all others stand."""
    answered = _unanswered(runs)
    name, *others = answered
    run = runs[name]
    variants: dict[str, list[_Timed]] = {}
    no_solver = ""
    solved = _outcomes(scenes) if stated is None else None
    with Progress(len(scenes.indices), "scenes", progress) as bar:
        _answer(runs, scenes, scenes.indices[0], _unanswered(runs))  # takes longer, so it does not count
        for index, scene in zip(scenes.indices, scenes.names, strict=True):
            _answer(runs, scenes, index, answered)
            try:
                for outcome in next(solved) if solved is not None else ():
                    one = _Timed(outcome.errors, outcome.whole_seconds) if outcome.converged else _NONE
                    variants.setdefault(outcome.variant.name, []).append(one)
            except (ConfigError, SimulationError) as error:
                no_solver = str(error)
                solved = None
                variants = {}
            bar.advance(scene)
        process = process_beside(run.model, scenes.dataset, scenes.split, scenes.indices, bar.line)
    quantities = _quantities(one for timed in answered[name].values() for one in timed)
    if stated is not None:
        variants = {"as stated": [_Timed(dict.fromkeys(quantities, 0.0), stated)] * len(scenes.indices)}
    finer = _on_finer_mesh(scenes, variants)
    shared = {
        "scenes": scenes.names,
        "no_solver": no_solver,
        "invested": _invested(run, scenes.dataset),
        "origin": {**provenance(command), "run": str(run.path), "step": run.step, "data": str(scenes.dataset.path)},
    }
    return {
        quantity: TradeFigures(
            run=_of_run(run, scenes, answered[name], quantity),
            solver=tuple(_setting(variant, timed, quantity) for variant, timed in variants.items()),
            mesh_errors=tuple(outcome.errors[quantity] for outcome in finer),
            quantity=quantity,
            others=(
                *(Side(other, _of_run(runs[other], scenes, answered[other], quantity)) for other in others),
                *process.sides(quantity),
            ),
            no_process=process.why_not(quantity),
            **shared,
        )
        for quantity in quantities
    }


def _unanswered(runs: Mapping[str, Run]) -> dict[str, dict[Effort, list[_Timed]]]:
    """The efforts of each run among which one is chosen; of a run that predicts step by step, the only one."""
    return {
        name: {effort: [] for effort in choices(run.settings.model, run.settings.train.corrections) or (run.effort,)}
        for name, run in runs.items()
    }


def _answer(
    runs: Mapping[str, Run], scenes: _Scenes, index: int, answered: Mapping[str, Mapping[Effort, list[_Timed]]]
) -> None:
    """Add what each effort of each run gives for a scene. All are judged by the fields that the first run
    predicts, and by stored reactions."""
    first, *_ = runs.values()
    fields = judging_fields(first.settings.model)
    for name, of_run in answered.items():
        for effort, timed in of_run.items():
            answer = timed_answer(runs[name].model, scenes.dataset, scenes.split, index, effort, fields)
            timed.append(_Timed(*answer[:2]))


def _of_run(
    run: Run, scenes: _Scenes, answered: Mapping[Effort, Sequence[_Timed]], quantity: str
) -> tuple[Setting, ...]:
    """The efforts of a run as settings."""
    return tuple(
        _setting(effort.text, timed, quantity, _command(run, scenes, effort)) for effort, timed in answered.items()
    )


class _Timed(NamedTuple):
    """The errors of an answer by quantity, and its seconds."""

    errors: Mapping[str, float]
    seconds: float


_NONE = _Timed({}, math.inf)  # where there is no answer


def _quantities(answers: Iterable[_Timed]) -> list[str]:
    """What all answers have an error of."""
    answered = [one.errors for one in answers if one.errors]
    return [quantity for quantity in QUANTITIES if all(quantity in errors for errors in answered)]


def _setting(name: str, timed: Sequence[_Timed], quantity: str, command: str = "") -> Setting:
    errors = tuple(one.errors.get(quantity, math.inf) for one in timed)
    return Setting(name, errors, tuple(one.seconds for one in timed), command)


def _outcomes(scenes: _Scenes) -> Iterator[tuple[Outcome, ...]]:
    """What each variant of the solver took for each scene. It begins with the first one, where all errors come up."""
    dataset, split, indices, made_from = scenes
    for solved in solver_outcomes(dataset.path, split, indices, made_from=made_from, progress=False):
        yield solved.outcomes


def _on_finer_mesh(scenes: _Scenes, variants: Mapping[str, Sequence[_Timed]]) -> list[Outcome]:
    """Frames of the dataset on a mesh of 8 times the nodes.

    Scenes that cannot be solved there are left out. None is tried if our solver has not run or would take too long.
    """
    from ast_sim.simulate.jobs.mesh_error import LONGER, MOST_SECONDS  # takes 0.2 s

    own = [one.seconds for one in variants.get(OWN_STOP_TEST, ())]
    if not own or LONGER * max(own[:MESH_SCENES]) > MOST_SECONDS:
        return []
    dataset, split, indices, made_from = scenes
    some = indices[:MESH_SCENES]
    solved = solver_outcomes(
        dataset.path, split, some, variants=(FINER,), starts=(1,), made_from=made_from, progress=False
    )
    return [outcome for scene in solved for outcome in scene.outcomes if outcome.converged]


def timed_answer(
    model: Simulator, dataset: Dataset, split: str, index: int, effort: Effort, fields: Sequence[str] = ()
) -> tuple[dict[str, float], float, str | None]:
    """The errors of an answer at the deepest frame by quantity, its processor seconds (infinite if it failed), and why.

    The scene is loaded again, so nothing is prepared for its mesh; with these named fields, by which the force is
    judged.
    """
    truth = dataset.load(split, index, fields)
    frame = deepest_predicted(model, truth)
    question = Question.of(truth, f"{split}/{index:06d}", [frame])
    began = time.process_time()
    (answer,) = answers(model, [question], effort)
    seconds = time.process_time() - began
    if answer.failure is not None:
        return {}, math.inf, answer.failure
    return errors_of(replace(answer, info=dataset.info), truth), seconds, None


def _command(run: Run, scenes: _Scenes, effort: Effort) -> str:
    """What predicts the first scene with this effort."""
    what = options_of(effort) if run.settings.model.scheme.corrects else []
    scene = [scenes.dataset.path.name, "--split", scenes.split, "--index", str(scenes.indices[0])]
    return shlex.join(["ast-sim", "predict", run.path.name, *scene, "--out", "answer.h5", *what])


def _invested(run: Run, dataset: Dataset) -> float | None:
    """The processor seconds of the solver for the training scenes and the seconds of the training, if the run has
    learned from this dataset."""
    steps = run.settings.train.steps
    step = run.folder.metrics.seconds_per_step()
    samples = read_seconds(dataset).samples
    simulated = [sum(seconds) for name, seconds in samples.items() if name.startswith(("train/", "valid/"))]
    if step is None or steps is None or not simulated or Path(run.settings.data).resolve() != dataset.path.resolve():
        return None
    return sum(simulated) + step * steps
