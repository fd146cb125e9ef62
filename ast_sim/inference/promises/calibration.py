"""How far to trust an answer: split conformal prediction, by scene.

Frames and nodes of one scene depend on each other, so the scene is what is exchangeable. The score of a calibration
scene is the largest error of a free node in any frame, over the scale of that frame: the root mean square displacement
of the free nodes in the answer. Let q be the ceil((n + 1) LEVEL)-th smallest of n scores. Then in a fresh scene of the
same kind all free nodes of all frames lie within q times the scale, with a probability of at least LEVEL, whatever the
model is (Vovk, Gammerman, Shafer 2005; Angelopoulos, Bates 2023, section 1). It holds on average over calibrations and
fresh scenes. The calibration scenes must not have trained or chosen the model; so nothing needs to be crossed, and n
scores are enough from the n on for which the rank is at most n.

What errors the answers keep, and which effort is enough for an asked one: `kept_errors`.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ast_sim.inference.answer import LEVEL
from ast_sim.inference.effort import Effort, choices
from ast_sim.inference.promises.kept_errors import KEPT, KeptErrors
from ast_sim.inference.relative_errors import moves
from ast_sim.runs.scope import LEEWAY, size_of, spacing_of
from ast_sim.scene import Scene
from ast_sim.simulate.jobs.rival import deepest_frame
from ast_sim.support.errors import ConfigError
from ast_sim.support.progress import Progress

if TYPE_CHECKING:
    from ast_sim.dataset.reader import Dataset
    from ast_sim.inference.answer import Answer
    from ast_sim.inference.trained_run import Run

FLOOR = 1e-6  # of a scale, relative to the size of the deforming bodies: where nothing moves, rounding is left
FEWEST = math.ceil(LEVEL / (1 - LEVEL) - 1e-9)  # scenes with which the rank of the quantile is at most their number


@dataclass(frozen=True)
class Calibration:
    """What the calibration scenes say of the answers of a run with one effort.

    Attributes:
        quantile: q, the width of the band over the scale.
        scenes: the number of calibration scenes.
        effort: the effort of the answers.
        spacing: (lowest, highest) mean length of the mesh edges of the deforming bodies in these scenes.
        kept: the errors of these scenes after each effort.
    """

    quantile: float
    scenes: int
    effort: Effort
    spacing: tuple[float, float]
    kept: KeptErrors = field(default_factory=KeptErrors, repr=False)

    @property
    def text(self) -> str:
        """The band in words."""
        return (
            f"band: with {100 * LEVEL:g} % all free nodes of all frames lie within {self.quantile:.3g} times the root"
            f" mean square displacement of the frame, by {self.scenes} scenes ({self.effort.text}){self._kept}"
        )

    @property
    def _kept(self) -> str:
        """The errors that efforts keep, in words."""
        told = ""
        for quantity in self.kept.errors:
            bounds = zip(self.kept.bounds(quantity), self.kept.efforts, strict=True)
            known = [f"{100 * bound:.2g} % with {effort.text}" for bound, effort in bounds if math.isfinite(bound)]
            if known:
                told += f"\n{quantity}: error at the deepest frame in {100 * KEPT:g} % of scenes: {'; '.join(known)}"
        return told

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        return {**asdict(self), "spacing": list(self.spacing), "kept": self.kept.to_json()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        low, high = values["spacing"]
        kept = KeptErrors.from_json(values["kept"]) if "kept" in values else KeptErrors()
        return cls(values["quantile"], values["scenes"], Effort(**values["effort"]), (low, high), kept)

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
    efforts = choices(run.settings.model, run.settings.train.calls)
    errors: list[list[dict[str, float] | None]] = [[] for _ in efforts]
    fields = [name for name, *_ in run.settings.model.data.fields]
    with Progress(dataset.count(split), 0, "scenes") as bar, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they tell is counted here
        for index in range(dataset.count(split)):
            bar.advance()
            truth = dataset.load(split, index, fields)
            name = f"{split}/{index:06d}"
            answer = run.predict(truth, throw=False, name=name) if moves(truth) else None
            if answer is None or answer.notes:
                left_out.append(name)
                continue
            true_position = truth.position[list(answer.frames)]
            failed = answer.failure is not None
            scores.append(math.inf if failed else score(answer.scene, answer.position, true_position))
            spacings.append(spacing_of(truth.scene))
            for effort, of_scenes in zip(efforts, errors, strict=True):
                deepest = run.predict(truth, frames=deepest_frame(truth), effort=effort, throw=False, name=name)
                of_scenes.append(None if deepest.failure is not None else deepest.errors(truth))
    width = quantile(scores)
    if math.isinf(width):
        raise ConfigError(f"{scores.count(math.inf)} of {len(scores)} predictions failed: no band holds")
    spacing = min(spacings), max(spacings)
    return Calibration(width, len(scores), run.effort, spacing, _kept_errors(efforts, errors)), left_out


def _kept_errors(efforts: Sequence[Effort], errors: Sequence[Sequence[Mapping[str, float] | None]]) -> KeptErrors:
    """The errors by quantity, effort and scene; None, where the prediction failed, is infinite."""
    known = [one for of_scenes in errors for one in of_scenes if one is not None]
    shared = [quantity for quantity in (known[0] if known else ()) if all(quantity in one for one in known)]
    by_quantity = {
        quantity: tuple(tuple(math.inf if one is None else one[quantity] for one in of_scenes) for of_scenes in errors)
        for quantity in shared
    }
    return KeptErrors(tuple(efforts), by_quantity)
