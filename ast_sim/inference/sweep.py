"""A sweep: one quantity or more over many values of the parameters of an assembly, predicted in batches."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ast_sim.inference.answer import Answer
from ast_sim.inference.answering import impossible
from ast_sim.inference.assembly_questions import AssemblyQuestion, questions_of, values_of_rows
from ast_sim.inference.effort import Effort
from ast_sim.inference.promises.chosen_effort import ErrorLimit
from ast_sim.mechanics.linearised.linearised_contact import STILL
from ast_sim.models.model_config import ModelConfig
from ast_sim.runs.scope import Scope
from ast_sim.simulate.own_assembly.parameters import Values, flattened
from ast_sim.support.argument_checks import file_name
from ast_sim.support.errors import AstSimError, ConfigError, counted, warn
from ast_sim.support.notebook_table import one_line
from ast_sim.support.progress import Progress, ShowProgress
from ast_sim.view import sweep_files
from ast_sim.view.files import make_folder
from ast_sim.view.sweep_files import finished_rows

TOGETHER = 64  # scenes that are prepared and predicted at a time


@dataclass(frozen=True, eq=False)
class Sweep:
    """What a sweep has found.

    Attributes:
        rows: one for each set of values: the parameters by name, then `travel_of_nodes` (the largest travel of a
            prescribed node), `reaction` (newton) with its components, `largest_stress` (pascal) and where it is
            (`stress_at_x`, ...), `last_newton_step` (see `Answer.last_steps`), bands of a calibrated run (see
            `Answer.figures`), and `notes` where there are some: what lies outside the training, and elements that are
            turned over. Where there is no scene or no prediction, `failure` says why, in place of the figures.
        varied: the names of the parameters that differ between rows.
        length_unit: unit of all lengths.
        seconds: wall seconds of the model alone, for all rows.
    """

    rows: list[dict[str, Any]]
    varied: tuple[str, ...]
    length_unit: str
    seconds: float

    def __repr__(self) -> str:
        facts = {"rows": f"{len(self.rows):,}", "varied": ", ".join(self.varied) or "nothing"}
        failed = sum("failure" in row for row in self.rows)
        facts |= {"failed": failed, "not converged": self.not_converged, "seconds": f"{self.seconds:.3g}"}
        return one_line("Sweep", facts)

    @property
    def not_converged(self) -> int:
        """The number of rows whose Newton steps have not converged."""
        return sum(row.get("last_newton_step", 0.0) > STILL for row in self.rows)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all rows as CSV; a missing folder is made.

        Raises:
            AstSimError: the file cannot be written.
        """
        make_folder(file_name(path, "path").parent)
        sweep_files.write_table(path, self.rows)

    def picture(self, path: str | os.PathLike[str], quantity: str = "reaction") -> None:
        """Draw a quantity over the varied parameters (PNG): as curves over one or two, in colours over more.

        Raises:
            ConfigError: there is no such quantity, or nothing varies.
            AstSimError: the file cannot be written.
        """
        make_folder(file_name(path, "path").parent)
        sweep_files.write_picture(path, self.rows, self.varied, quantity, self.length_unit)


def sweep(
    predict_scenes: Callable[..., list[Answer]],
    config: ModelConfig,
    scope: Scope,
    trained: Mapping[str, Any] | None,
    spec: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    effort: Effort,
    error: ErrorLimit | None,
    nodes: int | None,
    part: str | os.PathLike[str] | None,
    progress: ShowProgress,
) -> Sweep:
    """Predict the last frame for each row of values.

    With friction a body may be in equilibrium in two places. So the frame before is predicted, too: Newton steps from
    there find the place that the load path leads to. A model of metal that yields must see where the motion turns back.
    Other models that jump need no frame between.

    Args:
        predict_scenes: of a `Run`.
        config, scope, trained: of its model, and the scenes and the specification that it was trained on.
        spec, rows, error, nodes, part, progress: as in `Run.sweep`.
        effort: as it is given, or as the error has chosen it.
    """
    if not rows:
        raise ConfigError("a sweep needs at least one row of values")
    values = values_of_rows(spec, rows)  # a mistake in the last row is told before the first one is predicted
    needs_load_path = config.data.rubs and effort.newton_steps > 0
    frames = None if needs_load_path or config.scheme.follows_motion else 2
    choice = {"effort": effort} if error is None else {"error": error}
    outcome = _Outcome()
    with Progress(len(rows), "rows", progress) as bar, finished_rows(part, outcome.table, len(rows), bar) as keep:
        for start in range(0, len(rows), TOGETHER):
            questions = questions_of(spec, rows[start : start + TOGETHER], scope, trained, frames, nodes)
            made = [one for one in questions if isinstance(one, AssemblyQuestion)]
            names = [f"row {start + number}" for number in range(len(questions))]
            own = [name for name, one in zip(names, questions, strict=True) if isinstance(one, AssemblyQuestion)]
            wanted = [-2, -1] if needs_load_path and made and len(made[0].motion.position) > 2 else [-1]
            scenes = [(one.scene, one.motion) for one in made]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # told once for all rows
                answers = predict_scenes(scenes, names=own, frames=wanted, throw=False, progress=False, **choice)
            outcome.unpromised += sum(error is not None and "promise" not in answer.source for answer in answers)
            outcome.seconds += sum(answer.seconds for answer in answers)
            predicted = iter(answers)
            for number, one in enumerate(questions, start):
                outcome.add(names[number - start], values[number], one, predicted)
            bar.advance(names[-1], len(questions))
            keep()
    outcome.tell()
    return Sweep(outcome.table, _varied(rows, outcome.table), scope.length_unit, outcome.seconds)


@dataclass
class _Outcome:
    """The rows so far, and what is to be told of them: a sentence of each row that failed, lies outside the training or
    has elements that are turned over, why scenes cannot be made, and the number of rows without a promised error."""

    table: list[dict[str, Any]] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    folded: list[str] = field(default_factory=list)
    unpromised: int = 0
    seconds: float = 0.0
    unmade: list[AstSimError] = field(default_factory=list)

    def add(
        self, name: str, values: Values, question: AssemblyQuestion | AstSimError, predicted: Iterator[Answer]
    ) -> None:
        """Add a row; if it has a scene, its answer is the next one."""
        if isinstance(question, AstSimError):
            self.unmade.append(question)
            self.failed.append(f"{name}: {question}")
            self.table.append({**values, "failure": str(question)})
            return
        answer = next(predicted)
        notes = [*question.notes, *answer.notes]
        over = impossible(answer)
        self.outside += [f"{name}: {note}" for note in notes[:1]]
        self.folded += [f"{name}: {text}" for text in over]
        row = _row(question.values, answer, question.origin, [*notes, *over])
        self.failed += [f"{name}: {row['failure']}"] if "failure" in row else []
        self.table.append(row)

    def tell(self) -> None:
        """Warn, once for all rows, of the ones that are in doubt.

        Raises:
            ConfigError, SimulationError: no scene can be made.
        """
        rows = len(self.table)
        if len(self.unmade) == rows:
            raise self.unmade[0]
        if self.failed:
            warn(f"{len(self.failed)} of {counted(rows, 'row')} failed; the first: {self.failed[0]}")
        if self.outside:
            lie = counted(rows, "row lies", "rows lie")
            warn(f"{len(self.outside)} of {lie} outside the training scenes; the first: {self.outside[0]}")
        if self.folded:
            warn(
                f"elements are turned over in {len(self.folded)} of {counted(rows, 'row')}; the first: {self.folded[0]}"
            )
        if self.unpromised:
            of_rows = f"{self.unpromised} of {counted(rows, 'row')}"
            warn(f"no error is promised in {of_rows}: their mesh or their ranges differ from the calibration scenes")


def _row(values: Mapping[str, Any], answer: Answer, origin: Sequence[float], told: Sequence[str]) -> dict[str, Any]:
    notes = {"notes": "; ".join(told)} if told else {}  # the table is read without the warnings
    if answer.failure is not None or not len(answer.position):
        return {**values, "failure": answer.failure or "no frame was predicted", **notes}
    return {**values, **answer.figures(origin)[-1], **notes}


def _varied(rows: Sequence[Mapping[str, Any]], table: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """The names, in the order in which the user gave them."""
    first = table[0]
    given = dict.fromkeys(name for row in rows for name, _ in flattened(row))
    return tuple(name for name in given if any(row[name] != first[name] for row in table))
