"""When a model of an assembly pays: what its scenes and its training cost, against what each answer saves."""

from __future__ import annotations

import math
import os
import shlex
import statistics
import time
import warnings
from dataclasses import dataclass
from numbers import Real

from ast_sim.dataset.reader import Dataset
from ast_sim.dataset.solver_seconds import read_seconds
from ast_sim.inference.effort import Effort
from ast_sim.inference.trained_run import Run
from ast_sim.number_arrays import measured_time
from ast_sim.planning.trials import LEAST, MINUTES, TIMED, Trials, counted_minutes, trial_folder
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.generate import checked_workers, generate
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError, counted
from ast_sim.support.progress import ShowProgress, duration
from ast_sim.support.toml_settings import require_range
from ast_sim.training.configure import configure
from ast_sim.training.loop import OFTEN
from ast_sim.view.files import make_folder

SOLVED = 4  # scenes
TIMED_ANSWERS = 3  # after a first one


@dataclass(frozen=True)
class Worth:
    """What a model of a specification costs and saves. `str` gives it in sentences.

    Attributes:
        spec: the specification.
        minutes, steps: how long the training takes, and its number of steps.
        scenes: the number of training scenes; the training sees each frame `OFTEN` times.
        workers: processes that solve scenes side by side.
        solve_seconds: processor time of the solver for a scene with all its frames, the median of `SOLVED`.
        answer_seconds: the median processor time of one call of the model for all frames of such a scene.
        step_seconds: of a training step.
        command: what makes the scenes.
    """

    spec: str
    minutes: float
    steps: int
    scenes: int
    workers: int
    solve_seconds: float
    answer_seconds: float
    step_seconds: float
    command: str

    @property
    def pays_after(self) -> int | None:
        """The questions after which the time for scenes and training is saved; None: never."""
        saved = self.solve_seconds - self.answer_seconds
        return math.ceil((self.scenes * self.solve_seconds + 60 * self.minutes) / saved) if saved > 0 else None

    def __str__(self) -> str:
        simulation = self.scenes * self.solve_seconds / self.workers
        after = self.pays_after
        return "\n".join([
            f"a scene takes the solver {measured_time(self.solve_seconds)}, an answer of the model"
            f" {measured_time(self.answer_seconds)}",
            f"{duration(60 * self.minutes)} are {self.steps:,} steps of {measured_time(self.step_seconds)}; with"
            f" {self.scenes:,} scenes each frame is seen {OFTEN} times",
            f"these scenes take {duration(simulation)} on {self.workers} {'core' if self.workers == 1 else 'cores'}",
            "a model does not pay: the solver is as fast" if after is None else
            f"the model pays after {after:,} questions; for fewer the solver alone is the better choice",
            self.command,
        ])  # fmt: skip


def worth(
    spec: str | os.PathLike[str],
    out: str | os.PathLike[str],
    minutes: float,
    *,
    nodes: int | None = None,
    frames: int | None = None,
    solver: str | None = None,
    progress: ShowProgress = True,
) -> Worth:
    """Solve a few scenes of a specification and time training steps and answers, to say when a model pays.

    Args:
        spec: the specification of an assembly (TOML).
        out: folder for the scenes and a training of a few steps; a second call goes on with what is there.
        minutes: the length of the training.
        nodes, frames, solver, progress: as for `generate`.

    Raises:
        AstSimError: the specification has a mistake, scenes cannot be solved, or the minutes are too few for a
            training.
    """
    require_type("minutes", minutes, Real, "a number")
    require_range("minutes", minutes, *MINUTES)
    read_spec(spec)  # a mistake in it leaves no folder
    folder = trial_folder(out)
    make_folder(folder)
    made = generate(
        "assembly", folder / "scenes.h5", train=SOLVED - 1, valid=1, test=0, nodes=nodes, frames=frames, solver=solver,
        spec=spec, progress=progress,
    )  # fmt: skip
    config = configure(made.path)
    with Dataset(made.path) as dataset:
        scene_seconds = [float(sum(seconds)) for seconds in read_seconds(dataset).samples.values()]
        answered = statistics.median(dataset.num_frames("train", index) for index in range(SOLVED - 1)) - 1
        truth = dataset["valid"][0]
    trial = Trials(folder, SOLVED - 1, 1).trained("tiny", config, TIMED)
    steps = int(60 * minutes / trial.seconds)
    if steps < LEAST:
        raise ConfigError(
            f"{counted_minutes(minutes)} too few: a training would have {counted(steps, 'step')} of"
            f" {measured_time(trial.seconds)}, and learns nothing from fewer than {LEAST}; plan for"
            f" {LEAST * trial.seconds / 60:.2g} minutes or more"
        )
    options = {"--nodes": nodes, "--frames": frames, "--solver": solver}
    given = [text for key, value in options.items() if value is not None for text in (key, str(value))]
    shown = steps * config.train.batch_size * config.train.accumulate
    scenes = max(SOLVED, math.ceil(shown / (OFTEN * answered)))
    making = ["ast-sim", "generate", "assembly", str(spec), "--out", "DATA.h5", "--count", str(scenes), *given]
    return Worth(
        spec=str(spec),
        minutes=minutes,
        steps=steps,
        scenes=scenes,
        workers=checked_workers(None, None),
        solve_seconds=statistics.median(scene_seconds),
        answer_seconds=_answer_seconds(Run(folder / trial.run), truth),
        step_seconds=trial.seconds,
        command=shlex.join(making),
    )


def _answer_seconds(run: Run, truth: Trajectory) -> float:
    """The median processor time of an answer after one call, without the first one, in which much is prepared."""
    seconds = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its weights are of no use; only its time counts
        for _ in range(1 + TIMED_ANSWERS):
            began = time.process_time()
            run.predict(truth, effort=Effort(), throw=False, progress=False)
            seconds.append(time.process_time() - began)
    return statistics.median(seconds[1:])
