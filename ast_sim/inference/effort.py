"""How much is computed for an answer: one dial from the fastest answer to an exact one.

The command line takes its options from here, so this module needs neither torch nor numpy. What a new dial needs:
docs/how-to/new-dial-or-band.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from statistics import fmean
from typing import TYPE_CHECKING, Any, Self

from ast_sim.support.argument_checks import require_bool, require_type
from ast_sim.support.errors import ConfigError, counted
from ast_sim.support.precisions import Precision, require_precision
from ast_sim.support.toml_settings import require_range, whole

if TYPE_CHECKING:
    from ast_sim.models.model_config import ModelConfig

GOOD = 0.02  # a relative error that most users call exact
GOOD_STRESS = 0.1  # the same of the stress, relative to the error of its mean
MOST_NEWTON_STEPS = 10  # by default; they end earlier where one is small
AGAIN = 2  # corrections that are added where Newton steps have not converged: the frame is then predicted again
STEPS_BEFORE_SOLVER = 1  # more hardly bring it nearer to equilibrium (docs/log.md, 2026-11-27)
CHOSEN_STEPS = (0, 1, 2, MOST_NEWTON_STEPS)  # among these numbers of Newton steps an effort is chosen
CHOSEN_MOVES = (0.15, 0.1, 0.075)  # and among these moves beyond which the solver goes on (docs/log.md, 2026-11-29)
WORTH = 0.05  # a correction or a Newton step must lower an error that is not good by this share


def _dial(text: str) -> Any:
    """A number of an effort, 0 by default; `text` is the help of its option on the command line."""
    return field(default=0, metadata={"help": text})


@dataclass(frozen=True)
class Effort:
    """What follows the first call of a model that jumps.

    Attributes:
        corrections: how many further calls of the model correct its answer.
        newton_steps: at most how many Newton steps of the solver then lead towards equilibrium. They end when a step is
            at most `STILL`. Where `MOST_NEWTON_STEPS` or more do not end, they begin again after more corrections.
            Stress then follows from the material.
        solved: the bundled solver then goes on to its own stop test; with friction, and where bodies still overlap, it
            follows the load path from rest, frame by frame, as if there were no model.
        solved_beyond: only frames that the Newton steps move away from the model's answer by more than this share of
            their displacement, or in which they fail, are solved: such an answer was too far from equilibrium to be
            trusted. 0: all frames.
        precision: the number format of factors when the model multiplies: "bfloat16" rounds them to 8 binary digits,
            which saves time in large scenes on some processors (`ast_sim.ops.products_in`).

    Raises:
        ConfigError: a number is not whole or negative, there is no such precision, or no frame is solved but
            `solved_beyond` is not 0.
    """

    corrections: int = _dial(
        "number of calls that correct the first one, in a run that predicts a frame directly (default: as validation"
        " found best)"
    )
    newton_steps: int = _dial(
        "largest number of Newton steps of the solver after these calls; they end when one is small (default: as"
        " validation found best; 0 with --corrections)"
    )
    solved: bool = False
    solved_beyond: float = 0.0
    precision: Precision = "float32"

    @classmethod
    def exact(cls) -> Self:
        """The effort whose answers end where the solver's stop test holds. A scene with several equilibria may end in
        another one than along the load path."""
        return cls(newton_steps=STEPS_BEFORE_SOLVER, solved=True)

    def __post_init__(self) -> None:
        for name, count in zip(DIALS, whole(0, **self._counts), strict=True):
            require_type(name, count, int, "a whole number")
            object.__setattr__(self, name, count)
        require_bool(solved=self.solved)
        require_range("solved_beyond", self.solved_beyond, 0)
        object.__setattr__(self, "solved_beyond", float(self.solved_beyond))
        if self.solved_beyond and not (self.solved and self.newton_steps):
            raise ConfigError("solved_beyond says which frames are solved after Newton steps: it needs both")
        require_precision(self.precision)

    @property
    def _counts(self) -> dict[str, int]:
        return {name: getattr(self, name) for name in DIALS}

    @property
    def text(self) -> str:
        """Such as "2 corrections, up to 1 Newton step, then the solver"."""
        parts = [(self.corrections, "correction"), (self.newton_steps, "Newton step")]
        told = ", up to ".join(counted(n, what) for n, what in parts if n or what == "correction")
        if self.solved:
            told += ", then the solver"
        if self.solved_beyond:
            told += f" where they move a frame by more than {100 * self.solved_beyond:g} %"
        if self.precision != "float32":
            told += f", in {self.precision}"
        return told

    def check(self, config: ModelConfig) -> None:
        """Raise ConfigError if the model cannot make this effort."""
        lacks = _lacks_for_solver(config) if self.solved else []
        if lacks:
            raise ConfigError(f"this run can give no exact answer: {'; '.join(lacks)}")
        for key, count in self._counts.items():
            if count and not config.scheme.corrects:
                raise ConfigError(f"{key} is {count}; it needs a run that jumps, and this one does not")
        if self.newton_steps and not config.data.tetrahedra:
            raise ConfigError(f"newton_steps is {self.newton_steps}; they need tetrahedra, and the elements have none")
        if self.newton_steps:
            try:
                config.data.material.require_law()
            except ConfigError as error:
                raise ConfigError(f"newton_steps is {self.newton_steps}, but {error}") from error


class DefaultEffort:
    """The attribute `effort` of a run: one that the run cannot make is refused where it is set."""

    def __get__(self, run: Any, owner: type | None = None) -> Any:
        return self if run is None else vars(run)["effort"]

    def __set__(self, run: Any, effort: Any) -> None:
        vars(run)["effort"] = require_effort(effort, run.settings.model)


def require_effort(effort: Any, config: ModelConfig) -> Effort:
    """The effort; ConfigError, if it is none or the model cannot make it."""
    require_type("effort", effort, Effort, "an Effort, such as ast_sim.Effort(newton_steps=1)")
    effort.check(config)
    return effort


DIALS = {one.name: one.metadata["help"] for one in fields(Effort) if one.metadata}  # its numbers, and their help
BUT_NEWTON_STEPS = [one.name for one in fields(Effort) if one.name != "newton_steps"]
FIRST_CALL = Effort()


def option(dial: str) -> str:
    """The option of a dial on the command line, such as --newton-steps."""
    return f"--{dial.replace('_', '-')}"


def options_of(effort: Effort) -> list[str]:
    """The options that ask for an effort on the command line."""
    precision = [] if effort.precision == "float32" else ["--precision", effort.precision]
    if replace(effort, precision="float32") == Effort.exact():
        return ["--exact", *precision]
    beyond = ["--solved-beyond", f"{effort.solved_beyond:g}"] if effort.solved_beyond else []
    return [text for dial in DIALS for text in (option(dial), str(getattr(effort, dial)))] + beyond + precision


@dataclass(frozen=True)
class EffortErrors:
    """What an effort led to at the deepest frame of a validation scene, or in the mean over such scenes.

    Attributes:
        effort: the effort.
        error: of the displacement, relative to it; None: the prediction failed.
        stress_error: of the stress, relative to the error of the frame's true mean; None: there is no stress.
        steps: the Newton steps that were made.
        not_converged: the share of the scenes in which the Newton steps have not converged.
    """

    effort: Effort
    error: float | None
    stress_error: float | None
    steps: float
    not_converged: float

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `dataclasses.asdict` gave."""
        return cls(**{**values, "effort": Effort(**values["effort"])})


def mean_errors(of_scenes: Sequence[Sequence[EffortErrors]]) -> list[EffortErrors]:
    """For each effort the mean over the scenes; an error that one scene lacks is None."""
    means = []
    for same in zip(*of_scenes, strict=True):
        means.append(
            EffortErrors(
                same[0].effort,
                _mean([one.error for one in same]),
                _mean([one.stress_error for one in same]),
                fmean(one.steps for one in same),
                fmean(one.not_converged for one in same),
            )
        )
    return means


def error_with(effort: Effort, measured: Sequence[EffortErrors]) -> float | None:
    """The error that was measured with this effort; with more Newton steps than were measured, the error after the
    most; None: it was not measured."""
    require_type("effort", effort, Effort, "an Effort")
    steps = {one.effort.newton_steps: one for one in measured if _but_newton_steps(one.effort, effort)}
    nearest = steps.get(min(effort.newton_steps, max(steps, default=0)))
    return None if nearest is None else nearest.error


def _but_newton_steps(one: Effort, other: Effort) -> bool:
    """Whether two efforts differ in nothing, or in their Newton steps alone."""
    return all(getattr(one, name) == getattr(other, name) for name in BUT_NEWTON_STEPS)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fmean(known) if len(known) == len(values) else None


def can_make_newton_steps(config: ModelConfig) -> bool:
    """Whether the scenes of a model that jumps are tetrahedra of a material whose law is known."""
    return not _lacks_for_newton_steps(config)


def can_be_solved(config: ModelConfig) -> bool:
    """Whether the solver can end an answer: the range of contact must be known, too."""
    return not _lacks_for_solver(config)


def _lacks_for_newton_steps(config: ModelConfig) -> list[str]:
    """What keeps Newton steps from following an answer."""
    lacks = [] if config.scheme.corrects else ["its model does not jump"]
    lacks += [] if config.data.tetrahedra else ["its elements are no tetrahedra"]
    try:
        config.data.material.require_law()
    except ConfigError as error:
        lacks.append(str(error))
    return lacks


def _lacks_for_solver(config: ModelConfig) -> list[str]:
    """What keeps the solver from ending an answer."""
    lacks = _lacks_for_newton_steps(config)
    if config.data.contact_range <= 0:
        lacks.append("the range of contact is not known, which the bundled solver records with the scenes it makes")
    return lacks


def choices(config: ModelConfig, corrections: int) -> tuple[Effort, ...]:
    """The efforts among which one is chosen for a wanted error or time, from the cheapest to the dearest, for a model
    that was trained for this number of corrections: a Newton step costs more than a correction, and the solver most.
    With friction the solver is not among them: it follows the whole load path. None for a model that does not jump."""
    if not config.scheme.corrects:
        return ()
    steps = CHOSEN_STEPS if can_make_newton_steps(config) else (0,)
    efforts = tuple(Effort(made, count) for count in steps for made in range(corrections + 1))
    if not can_be_solved(config):
        return efforts
    partly = tuple(replace(efforts[-1], solved=True, solved_beyond=move) for move in CHOSEN_MOVES)
    return (*efforts, *partly) if config.data.rubs else (*efforts, *partly, Effort.exact())


def to_measure(config: ModelConfig, corrections: int) -> tuple[Effort, ...]:
    """The efforts whose errors validation measures, each with up to `MOST_NEWTON_STEPS` Newton steps if the model can
    make them, for a model that was trained for this number of corrections."""
    steps = MOST_NEWTON_STEPS if can_make_newton_steps(config) else 0
    return tuple(Effort(made, steps) for made in range(corrections + 1))


def cheapest_good(measured: Sequence[EffortErrors]) -> Effort:
    """The default effort of a run: Newton steps until one is small, or none, since scenes differ in how many they need.

    Stress tells more than the displacement: it follows from strains, and a step that leaves single elements distorted
    hardly moves their nodes. So an effort is good if both errors are small, or nearly the smallest that were measured;
    if no effort is good in both, the error of the displacement decides. Among the good efforts, the ones whose Newton
    steps ended in most scenes go first. Of these, the effort with the fewest corrections and Newton steps is taken.

    Args:
        measured: means over validation scenes, by effort. If all predictions failed, the first call alone is returned.
    """
    most = max((one.effort.newton_steps for one in measured), default=0)
    errors = {one: one.error for one in measured if one.error is not None and one.effort.newton_steps in (0, most)}
    if not errors:
        return FIRST_CALL
    stresses = {one: math.inf if one.stress_error is None else one.stress_error for one in errors}
    enough = max(GOOD, (1 + WORTH) * min(errors.values()))
    enough_stress = max(GOOD_STRESS, (1 + WORTH) * min(stresses.values()))
    accurate = [one for one, error in errors.items() if error <= enough]
    both = [one for one in accurate if stresses[one] <= enough_stress]
    good = both or accurate
    fewest = min(one.not_converged for one in good)
    converged = [one for one in good if one.not_converged <= fewest]
    return min(converged, key=lambda one: (one.effort.corrections + one.steps, one.effort.corrections)).effort
