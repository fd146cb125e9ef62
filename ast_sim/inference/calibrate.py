"""The calibration of a run: its answers to scenes that are new to it, compared with the truth."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ast_sim.dataset.reader import Dataset
from ast_sim.inference.answer import Answer
from ast_sim.inference.effort import Effort, choices
from ast_sim.inference.predict_arguments import new_question
from ast_sim.inference.promises.calibration import Calibration
from ast_sim.inference.promises.familiarity import Familiarity
from ast_sim.inference.promises.kept_errors import DISPLACEMENT, KeptErrors
from ast_sim.inference.promises.known_weights import require_known_weights
from ast_sim.inference.quantities.band import LEVEL, Comparison, compared
from ast_sim.inference.quantities.relative_errors import QUANTITIES, judging_fields, moves
from ast_sim.inference.trained_run import Run
from ast_sim.prescribed_motion import Motion
from ast_sim.runs.scope import spacing_of
from ast_sim.scene import Trajectory
from ast_sim.simulate.jobs.fastest_solver import deepest_frame
from ast_sim.support.argument_checks import require_type
from ast_sim.support.errors import ConfigError, counted, warn
from ast_sim.support.progress import Progress, ShowProgress

FEWEST = math.ceil(LEVEL / (1 - LEVEL) - 1e-9)  # scenes with which the rank of the quantile is at most their number


def quantile(scores: Sequence[float]) -> float:
    """The ceil((n + 1) LEVEL)-th smallest of n scores; n is at least `FEWEST`."""
    return sorted(scores)[math.ceil((len(scores) + 1) * LEVEL - 1e-9) - 1]


def calibrate(
    run: Run,
    data: str | os.PathLike[str] | Dataset | None = None,
    split: str = "calibration",
    *,
    progress: ShowProgress = True,
) -> Calibration:
    """Measure how far the answers of a run are from the truth, after its default effort and each effort among which one
    is chosen for a wanted error; then answers with these efforts have a band.

    The scenes must be new to the run: they have neither trained nor chosen it. Scenes outside the ranges of the
    training do not count, since no band is given there; neither do scenes without motion, nor scenes of another dataset
    that have trained or chosen the run all the same, as after a second conversion. Warnings say how many. The folder of
    a run keeps the result beside its best checkpoint, and `Run.save` takes it along.

    Args:
        run: the run. A file is not changed: only this object knows the band, and a file that `run.save` writes of it.
        data: a dataset, its path or open; by default the one that the run was trained on.
        split: whose scenes are predicted.
        progress: as in `generate`.

    Raises:
        ConfigError: the split has trained or chosen the run, there are fewer than 19 scenes, or too many fail.
        CheckpointError: the folder of the run cannot be written, or a process trains in it.
    """
    require_runs(run)
    with run.open(data) as dataset:
        known = _known_scenes(run, dataset, split)
        require_known_weights(run, "calibrate")
        with run.folder.held():  # which will keep the result
            before = run.calibration
            run.calibration = None  # it has no say in which scenes count
            try:
                result, left_out = _measured(run, dataset, split, known, progress)
            except BaseException:
                run.calibration = before
                raise
            run.calibration = result
            run.folder.keep_calibration(result.to_json())
    if known:
        count = counted(len(known), "scene does", "scenes do")
        warn(f"{count} not count, which have trained or chosen the run; the first is {known[0]}")
    if left_out:
        count = counted(len(left_out), "scene does", "scenes do")
        warn(f"{count} not count, outside the training or without motion; the first is {next(iter(left_out))}")
    if run.path.is_file():
        warn(f"{run.path} is a file, which is not changed: Run.save writes one with the band")
    return result


def require_runs(*runs: Any) -> None:
    """Raise ConfigError unless these are trained runs."""
    for run in runs:
        require_type("a run", run, Run, "a Run, such as ast_sim.Run(folder)")


def _known_scenes(run: Run, dataset: Dataset, split: str) -> list[str]:
    """The names of the scenes of a split that have trained or chosen the run; raise ConfigError if all have."""
    known = run.folder.learned(dataset, split)
    if known and len(known) == dataset.count(split):
        raise ConfigError(f"the scenes of {split} have trained or chosen the run: take other scenes")
    return [f"{split}/{index:06d}" for index in known]


def require_new_scenes(run: Run, dataset: Dataset, split: str) -> None:
    """Raise ConfigError if scenes of a split have trained or chosen the run, in whatever dataset they stand now."""
    known = _known_scenes(run, dataset, split)
    if known:
        raise ConfigError(
            f"{len(known)} of {counted(dataset.count(split), 'scene')} of {split} have trained or chosen the run, the"
            f" first is {known[0]}: take other scenes"
        )


class _Measured(NamedTuple):
    """A calibration scene.

    Attributes:
        comparisons: of the quantities in all frames, for each effort with a band; None where the prediction failed.
        errors: of the deepest frame, for each effort among which one is chosen; None where the prediction failed.
        spacing, farthest: as `Calibration` has their ranges.
        latents: [frames, D]; None: the model does not tell.
    """

    comparisons: list[dict[str, Comparison] | None]
    errors: list[dict[str, float] | None]
    spacing: float
    farthest: float
    latents: np.ndarray | None


def _measured(
    run: Run, dataset: Dataset, split: str, known: Sequence[str], progress: ShowProgress
) -> tuple[Calibration, dict[str, str]]:
    """The calibration by the scenes of a split without the `known` ones, and by name why others do not count."""
    to_choose = choices(run.settings.model, run.settings.train.corrections)
    efforts = to_choose if run.effort in to_choose else (*to_choose, run.effort)
    scenes: list[_Measured] = []
    fields = judging_fields(run.settings.model)
    every = [f"{split}/{index:06d}" for index in range(dataset.count(split))]
    names = {index: name for index, name in enumerate(every) if name not in known}
    reasons = {name: _why_not(run, dataset.load(split, index, fields), name) for index, name in names.items()}
    left_out = {name: why for name, why in reasons.items() if why}
    _require_enough(len(every), len(known), left_out)
    with Progress(len(names), "scenes", progress) as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they tell is counted here
        for index, name in names.items():
            if name not in left_out:
                truth = dataset.load(split, index, fields)
                scenes.append(_measured_scene(run, truth, name, efforts, to_choose))
            bar.advance(name)
    quantiles, typical = _quantiles([one.comparisons for one in scenes])
    spacings, distances = [one.spacing for one in scenes], [one.farthest for one in scenes]
    latents = [one.latents for one in scenes if one.latents is not None]
    familiarity = Familiarity.of(latents) if len(latents) >= FEWEST else None
    errors_of_efforts = [list(errors) for errors in zip(*(one.errors for one in scenes), strict=True)]
    kept = _kept_errors(to_choose, errors_of_efforts)
    ranges = (min(spacings), max(spacings)), (min(distances), max(distances))
    return Calibration(len(scenes), efforts, quantiles, typical, *ranges, kept, familiarity), left_out


def _why_not(run: Run, truth: Trajectory, name: str) -> str:
    """Why a scene does not count: nothing moves in it, or where it lies outside the training; empty if it counts."""
    if not moves(truth):
        return "nothing moves"
    notes = new_question(run.settings.model, run.scope, truth, None, None, name, None).notes
    return next(iter(notes), "")


def _require_enough(scenes: int, known: int, left_out: Mapping[str, str]) -> None:
    """Raise ConfigError if too few of the scenes are left for a band."""
    if scenes - known - len(left_out) < FEWEST:
        reasons = {"have trained or chosen the run": known, "lie outside the training or do not move": len(left_out)}
        without = "".join(f", {count} of which {reason}" for reason, count in reasons.items() if count)
        first = "".join(f" (the first, {name}: {why})" for name, why in list(left_out.items())[:1])
        raise ConfigError(
            f"a band of {100 * LEVEL:g} % needs at least {FEWEST} calibration scenes, and there are"
            f" {scenes}{without}{first}: make more with generate(..., calibration=N) (--calibration N)"
            + (", like the training scenes" if first else "")
        )


def _quantiles(
    scenes: Sequence[Sequence[Mapping[str, Comparison] | None]],
) -> tuple[dict[str, tuple[float, ...]], dict[str, float]]:
    """The quantiles of each quantity, one for each effort, and the typical sizes, from the comparisons by scene.

    Raises:
        ConfigError: with each effort too many predictions failed.
    """
    known = [one for scene in scenes for one in scene if one is not None]
    quantiles: dict[str, tuple[float, ...]] = {}
    typical: dict[str, float] = {}
    for quantity in known[0] if known else ():
        if not all(quantity in one for one in known):
            continue
        sizes = np.concatenate([one[quantity].true_sizes for one in known])
        typical[quantity] = float(np.sqrt(np.square(sizes).mean()))
        quantiles[quantity] = tuple(
            quantile([math.inf if one is None else one[quantity].score(typical[quantity]) for one in of_effort])
            for of_effort in zip(*scenes, strict=True)
        )
    if all(map(math.isinf, quantiles.get(DISPLACEMENT, ()))):
        failed = min(of_effort.count(None) for of_effort in zip(*scenes, strict=True))
        raise ConfigError(f"{failed} of {counted(len(scenes), 'prediction')} failed: no band holds")
    return quantiles, typical


def _measured_scene(
    run: Run, truth: Trajectory, name: str, efforts: Sequence[Effort], to_choose: Sequence[Effort]
) -> _Measured:
    """A calibration scene."""
    answers = [run.predict(truth, effort=effort, throw=False, name=name, progress=False) for effort in efforts]
    comparisons = [None if one.failure is not None else compared(one, truth) for one in answers]
    errors = [
        _errors_alone(run, truth, name, effort, answer) for effort, answer in zip(to_choose, answers, strict=False)
    ]
    latents = np.stack(list(answers[0].latents.values())) if answers[0].latents else None
    farthest = Motion(truth.position).farthest(truth.scene)
    return _Measured(comparisons, errors, spacing_of(truth.scene), farthest, latents)


def _errors_alone(run: Run, truth: Trajectory, name: str, effort: Effort, whole: Answer) -> dict[str, float] | None:
    """The errors at the deepest frame where it alone is predicted; None: the prediction failed. Without friction the
    other frames have no say in a frame, so the answer with all frames, `whole`, has the same one."""
    if run.settings.model.data.rubs or whole.failure is not None:
        deepest = deepest_frame(truth)
        alone = run.predict(truth, frames=deepest, effort=effort, throw=False, name=name, progress=False)
        return None if alone.failure is not None else alone.errors(truth)
    return whole.errors(truth)


def _kept_errors(efforts: Sequence[Effort], errors: Sequence[Sequence[Mapping[str, float] | None]]) -> KeptErrors:
    """The errors by quantity, effort and scene; infinite where the prediction failed, which is None, or where the true
    quantity is 0."""
    by_quantity = {
        quantity: tuple(tuple((one or {}).get(quantity, math.inf) for one in of_scenes) for of_scenes in errors)
        for quantity in QUANTITIES
        if any(quantity in one for of_scenes in errors for one in of_scenes if one is not None)
    }
    return KeptErrors(tuple(efforts), by_quantity)
