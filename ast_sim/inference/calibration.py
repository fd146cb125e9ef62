"""How far to trust an answer: split conformal prediction, by scene.

Frames and nodes of one scene depend on each other, so the scene is what is exchangeable. The score of a calibration
scene is the largest error of a free node in any frame, over the scale of that frame: the root mean square displacement
of the free nodes in the answer. Let q be the ceil((n + 1) LEVEL)-th smallest of n scores. Then in a fresh scene of the
same kind all free nodes of all frames lie within q times the scale, with a probability of at least LEVEL, whatever the
model is (Vovk, Gammerman, Shafer 2005; Angelopoulos, Bates 2023, section 1). It holds on average over calibrations and
fresh scenes. The calibration scenes must not have trained or chosen the model; so nothing needs to be crossed, and n
scores are enough from the n on for which the rank is at most n.

The same holds for the relative error at the deepest frame: the ceil((n + 1) (1 - a))-th smallest of n errors bounds the
error of a fresh scene with a probability of at least 1 - a. `effort_for` chooses among K efforts by such bounds, and
any of them may be wrong. So each has a = (1 - KEPT) / K; then all K bounds hold at once with a probability of at least
KEPT (Bonferroni), and with it the bound of the effort that is chosen.
"""

from __future__ import annotations

import dataclasses
import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ast_sim.inference.effort import MOST_NEWTON_STEPS, Effort, can_make_newton_steps
from ast_sim.runs.scope import LEEWAY, size_of, spacing_of
from ast_sim.scene import Scene
from ast_sim.support.errors import ConfigError
from ast_sim.support.progress import Progress

if TYPE_CHECKING:
    from ast_sim.dataset.reader import Dataset
    from ast_sim.inference.answer import Answer
    from ast_sim.inference.question import Question
    from ast_sim.inference.trained_run import Run
    from ast_sim.scene import Trajectory

LEVEL = 0.95
FLOOR = 1e-6  # of a scale, relative to the size of the deforming bodies: where nothing moves, rounding is left
KEPT = 0.9  # of the scenes keep the error that was asked for
STEPS = (0, 1, 2, MOST_NEWTON_STEPS)  # among these numbers of Newton steps `effort_for` chooses
FEWEST = math.ceil(LEVEL / (1 - LEVEL) - 1e-9)  # scenes with which the rank of the quantile is at most their number


@dataclass(frozen=True)
class Promise:
    """An effort, and the bound of its relative error at the deepest frame; None: too few scenes, or too many failed."""

    effort: Effort
    error: float | None


@dataclass(frozen=True)
class Calibration:
    """What the calibration scenes say of the answers of a run with one effort.

    Attributes:
        quantile: q, the width of the band over the scale.
        scenes: the number of calibration scenes.
        effort: the effort of the answers.
        spacing: (lowest, highest) mean length of the mesh edges of the deforming bodies in these scenes.
        promises: bounds of the relative error, from the cheapest effort to the dearest; none for a model that predicts
            step by step.
    """

    quantile: float
    scenes: int
    effort: Effort
    spacing: tuple[float, float]
    promises: tuple[Promise, ...] = ()

    @property
    def text(self) -> str:
        """The band in words."""
        promised = [f"{100 * one.error:.2g} % with {one.effort.text}" for one in self.promises if one.error is not None]
        more = (
            f"; error at the deepest frame in {100 * KEPT:g} % of the scenes: {', '.join(promised)}" if promised else ""
        )
        return (
            f"band: with {100 * LEVEL:g} % all free nodes of all frames lie within {self.quantile:.3g} times the root"
            f" mean square displacement of the frame, by {self.scenes} scenes ({self.effort.text}){more}"
        )

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        return {**dataclasses.asdict(self), "spacing": list(self.spacing)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        low, high = values["spacing"]
        promises = tuple(Promise(Effort(**one["effort"]), one["error"]) for one in values.get("promises", ()))
        return cls(values["quantile"], values["scenes"], Effort(**values["effort"]), (low, high), promises)

    def effort_for(self, error: float) -> Effort:
        """The cheapest effort whose relative error at the deepest frame is at most `error` in 90 % of fresh scenes.

        Raises:
            ConfigError: no effort keeps this error; the text names the smallest that can be had.
        """
        if not 0 < error < 1:
            raise ConfigError(f"error is {error}; it must lie between 0 and 1, as 0.02 for 2 %")
        for promise in self.promises:
            if promise.error is not None and promise.error <= error:
                return promise.effort
        known = [(one.error, one.effort) for one in self.promises if one.error is not None]
        if not known:
            least = math.ceil(len(self.promises) / (1 - KEPT) - 1e-9) - 1
            why = (
                f"it was calibrated with {self.scenes} scenes, and needs at least {least}"
                if self.promises
                else "its calibration holds no errors; calibrate it again (a model that goes step by step has none)"
            )
            raise ConfigError(f"the run can promise no error: {why}")
        smallest, effort = min(known, key=lambda one: one[0])
        raise ConfigError(
            f"no effort of this run keeps an error of {100 * error:.3g} % in {100 * KEPT:g} % of the scenes: the"
            f" smallest is {100 * smallest:.3g} %, with {effort.text}"
        )

    def unlike(self, scene: Scene, notes: Sequence[str]) -> str:
        """Why the calibration scenes say nothing of a scene with `notes`; empty if they do."""
        spacing = spacing_of(scene)
        low, high = self.spacing
        if notes:
            return "the scene lies outside the ranges of the training"
        if not (1 - LEEWAY) * low <= spacing <= (1 + LEEWAY) * high:
            return f"the mesh edges are {spacing:.3g} long, in the calibration scenes {low:.3g} to {high:.3g}"
        return ""

    def band(self, answer: Answer, effort: Effort, notes: Sequence[str]) -> np.ndarray | None:
        """[S] how far from the truth a free node may be in each frame; None, and a warning that says why, where nothing
        is known: with another effort, for a scene with `notes`, on another mesh."""
        if effort != self.effort:
            why = f"the run was calibrated with {self.effort.text}"
        else:
            why = self.unlike(answer.scene, notes)
        if not why:
            return self.quantile * scales(answer.scene, answer.position)
        warnings.warn(f"{answer.name}: no band: {why}", stacklevel=4)
        return None


def promised_effort(
    run: Run, error: float | None, effort: Effort | None, question: Question
) -> tuple[Effort | None, dict[str, Any]]:
    """The effort for a question that asks for an error in place of an effort, and what the answer keeps of it; without
    an error, the effort as it is asked. See `Run.predict`."""
    if error is None:
        return effort, {}
    if effort is not None:
        raise ConfigError("an error chooses the effort: give one of them")
    if run.calibration is None:
        raise ConfigError(f"{run.path} promises no error before it is calibrated: ast-sim calibrate RUN DATA")
    chosen = run.calibration.effort_for(error)
    why = run.calibration.unlike(question.scene, question.notes)
    if why:
        warnings.warn(f"{question.name}: no error is promised: {why}", stacklevel=3)
        return chosen, {"effort": chosen.text}
    return chosen, {"asked_error": error, "effort": chosen.text}


def scales(scene: Scene, position: np.ndarray) -> np.ndarray:
    """[S] the root mean square displacement of the free nodes in frames [S, N, 3]."""
    moved = (position - scene.rest_position)[:, ~scene.prescribed].astype(np.float64)
    return np.maximum(np.sqrt(np.square(moved).sum(axis=2).mean(axis=1)), FLOOR * size_of(scene))


def score(scene: Scene, position: np.ndarray, truth: np.ndarray) -> float:
    """The largest error of a free node over the scale of its frame; both are [S, N, 3]."""
    error = (position - truth)[:, ~scene.prescribed].astype(np.float64)
    return float((np.linalg.norm(error, axis=2).max(axis=1) / scales(scene, position)).max())


def quantile(scores: Sequence[float]) -> float:
    """The ceil((n + 1) LEVEL)-th smallest of n scores.

    Raises:
        ConfigError: there are fewer than `FEWEST`.
    """
    if len(scores) < FEWEST:
        raise ConfigError(
            f"a band of {100 * LEVEL:g} % needs at least {FEWEST} calibration scenes, and there are {len(scores)}: make"
            " more with --calibration N"
        )
    return sorted(scores)[math.ceil((len(scores) + 1) * LEVEL - 1e-9) - 1]


def bound(errors: Sequence[float], efforts: int) -> float | None:
    """The ceil((n + 1) (1 - (1 - KEPT) / efforts))-th smallest of n errors; None: it is not among them, or infinite."""
    rank = math.ceil((len(errors) + 1) * (1 - (1 - KEPT) / efforts) - 1e-9)
    value = sorted(errors)[rank - 1] if rank <= len(errors) else math.inf
    return value if math.isfinite(value) else None


def calibrate(
    run: Run, data: str | os.PathLike[str] | Dataset | None = None, split: str = "calibration"
) -> Calibration:
    """Measure how far the answers of a run's default effort are from the truth; then each of its answers has a band.

    The scenes must be new to the run: they have neither trained nor chosen it. Scenes outside the ranges of the
    training do not count, since no band is given there; neither do those without motion. A warning says how many. The
    folder of a run keeps the result beside its best checkpoint, and `Run.save` takes it along.

    Args:
        run: the run. If it is a file, only this object knows the band.
        data: a dataset, its path or open; by default the one that the run was trained on.
        split: whose scenes are predicted.

    Raises:
        ConfigError: the split has trained or chosen the run, there are fewer than 19 scenes, or too many fail.
    """
    with run.open(data) as dataset:
        known = Path(run.settings.data).resolve() == dataset.path.resolve()
        if known and split in ("train", "valid"):
            raise ConfigError(f"the scenes of {split} have trained or chosen the run: calibrate with other scenes")
        run.calibration, left_out = _measured(run, dataset, split)
    if left_out:
        told = f"{len(left_out)} scenes lie outside the training or do not move, the first is {left_out[0]}"
        warnings.warn(f"{told}: they do not count", stacklevel=2)
    if run.path.is_dir():
        run.folder.keep_calibration(run.calibration.to_json())
    else:
        warnings.warn(f"{run.path} is a file, which is not changed: only this program knows the band", stacklevel=2)
    return run.calibration


def _measured(run: Run, dataset: Dataset, split: str) -> tuple[Calibration, list[str]]:
    """The calibration by the scenes of a split, and the names of those that do not count."""
    scores: list[float] = []
    spacings: list[float] = []
    left_out: list[str] = []
    choices = _choices(run)
    errors: dict[Effort, list[float]] = {effort: [] for effort in choices}
    with Progress(dataset.count(split), 0, "scenes") as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they tell is counted here
        for index in range(dataset.count(split)):
            bar.advance()
            truth = dataset[split][index]
            name = f"{split}/{index:06d}"
            answer = run.predict(truth, throw=False, name=name) if truth.num_frames > 1 else None
            if answer is None or answer.notes:
                left_out.append(name)
                continue
            true_position = truth.position[list(answer.frames)]
            failed = answer.failure is not None
            scores.append(math.inf if failed else score(answer.scene, answer.position, true_position))
            spacings.append(spacing_of(truth.scene))
            for effort, error in _errors(run, truth, choices).items():
                errors[effort].append(error)
    width = quantile(scores)
    if math.isinf(width):
        raise ConfigError(f"{scores.count(math.inf)} of {len(scores)} predictions failed: no band holds")
    promises = tuple(Promise(effort, bound(errors[effort], len(choices))) for effort in choices)
    spacing = min(spacings), max(spacings)
    return Calibration(width, len(scores), run.effort, spacing, promises), left_out


def _choices(run: Run) -> list[Effort]:
    """The efforts to choose from, from the cheapest to the dearest: a Newton step costs more than a correction."""
    config = run.settings.model
    if not config.jumps:
        return []
    steps = STEPS if can_make_newton_steps(config) else (0,)
    return [Effort(corrections, count) for count in steps for corrections in range(run.settings.train.calls)]


def _errors(run: Run, truth: Trajectory, choices: Sequence[Effort]) -> dict[Effort, float]:
    """The relative error of each effort at the deepest frame of a scene; infinite if the prediction failed."""
    if not choices:
        return {}
    most = Effort(max(one.corrections for one in choices), max(one.newton_steps for one in choices))
    measured = {one.effort: one.error for one in run.errors_by_effort(truth, most)}
    known = {effort: measured.get(effort) for effort in choices}
    return {effort: math.inf if error is None else error for effort, error in known.items()}
