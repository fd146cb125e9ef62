"""The effort of answers for which an error or a time is given in place of an effort."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from ast_sim.inference.effort import Effort, require_effort
from ast_sim.inference.promises.calibration import Calibration
from ast_sim.inference.promises.kept_errors import DISPLACEMENT, KEPT, in_words
from ast_sim.inference.promises.known_weights import forget_other_weights
from ast_sim.inference.promises.milliseconds import effort_within
from ast_sim.inference.quantities.forces_and_figures import STIFFER
from ast_sim.prescribed_motion import Motion
from ast_sim.support.errors import ConfigError, warn

if TYPE_CHECKING:
    from ast_sim.inference.predicting.question import Question
    from ast_sim.inference.trained_run import Run

ErrorLimit = float | Mapping[str, float]  # of the displacement, or by quantity: {"reaction": 0.05}


def chosen_effort(
    run: Run, questions: Sequence[Question], effort: Effort | None, error: ErrorLimit | None, ms: float | None = None
) -> tuple[Effort, list[dict[str, str]]]:
    """The effort, and for each question what its answer keeps of the choice; see `Run.predict`.

    Raises:
        ConfigError: more than one of effort, error and time is given; no effort keeps the error, or the time; or the
            run is not calibrated.
    """
    forget_other_weights(run)
    if sum(one is not None for one in (effort, error, ms)) > 1:
        raise ConfigError("an effort, an error and a time each choose what is computed: give one of them")
    if ms is not None:
        within, told = effort_within(run, questions[0], ms)
        return within, [{"effort": within.text, "promise": told} for _ in questions]
    if error is not None:
        return _keeping(run, questions, error if isinstance(error, Mapping) else {DISPLACEMENT: error})
    chosen = run.effort if effort is None else require_effort(effort, run.settings.model)
    return chosen, [{} for _ in questions]


def _keeping(
    run: Run, questions: Sequence[Question], wanted: Mapping[str, float]
) -> tuple[Effort, list[dict[str, str]]]:
    """The cheapest effort that keeps errors; a question unlike the calibration scenes is told, and promised nothing."""
    if run.calibration is None:
        raise ConfigError(f"{run.path} promises no error before it is calibrated: ast-sim calibrate RUN DATA")
    if "reaction" in wanted and run.info.corners_only:
        raise ConfigError(f"{run.path} promises no force: {STIFFER}")
    effort = run.calibration.kept.effort_for(wanted)
    promise = f"the cheapest that keeps {in_words(wanted)} at the deepest frame in {100 * KEPT:g} % of scenes like it"
    facts = []
    for question in questions:
        why = _why_nothing(run.calibration, question)
        if why:
            warn(f"{question.name}: no error is promised: {why}")
        facts.append({"effort": effort.text} if why else {"effort": effort.text, "promise": promise})
    return effort, facts


def _why_nothing(calibration: Calibration, question: Question) -> str:
    """Why the kept errors say nothing of a question; empty if they do."""
    if question.notes:
        return "the scene is unlike the scenes that the run knows"
    wanted = Motion(question.prescribed_position[list(question.wanted())])
    return calibration.unlike_errors(question.scene, wanted.farthest(question.scene))


def parse_error(text: str) -> tuple[str, float]:
    """A quantity and its error from "2%", "0.02", "reaction=5%" or "stress=0.1".

    Raises:
        ConfigError: it is none of these.
    """
    quantity, _, number = text.rpartition("=")
    try:
        percent = number.strip().endswith("%")
        value = float(number.strip().removesuffix("%")) / (100 if percent else 1)
    except ValueError as error:
        raise ConfigError(f"{text} is no error: give one such as 2%, 0.02 or reaction=5%") from error
    return quantity.strip() or DISPLACEMENT, value
