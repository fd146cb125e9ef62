"""How far to trust an answer: split conformal prediction, by scene.

Frames and nodes of one scene depend on each other, so the scene is what is exchangeable. The score of a calibration
scene is the largest error of a free node in any frame, over the scale of that frame: the root mean square displacement
of the free nodes in the answer. Let q be the ceil((n + 1) LEVEL)-th smallest of n scores. Then in a fresh scene of the
same kind all free nodes of all frames lie within q times the scale, with a probability of at least LEVEL, whatever the
model is (Vovk, Gammerman, Shafer 2005; Angelopoulos, Bates 2023, section 1). It holds on average over calibrations and
fresh scenes. The calibration scenes must not have trained or chosen the model; so nothing needs to be crossed, and n
scores are enough from the n on for which the rank is at most n.
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

from ast_sim.inference.effort import Effort
from ast_sim.runs.scope import LEEWAY, size_of, spacing_of
from ast_sim.scene import Scene
from ast_sim.support.errors import ConfigError
from ast_sim.support.progress import Progress

if TYPE_CHECKING:
    from ast_sim.dataset.reader import Dataset
    from ast_sim.inference.answer import Answer
    from ast_sim.inference.trained_run import Run

LEVEL = 0.95
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
    """

    quantile: float
    scenes: int
    effort: Effort
    spacing: tuple[float, float]

    @property
    def text(self) -> str:
        """The band in words."""
        return (
            f"band: with {100 * LEVEL:g} % all free nodes of all frames lie within {self.quantile:.3g} times the root"
            f" mean square displacement of the frame, by {self.scenes} scenes ({self.effort.text})"
        )

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        return {**dataclasses.asdict(self), "spacing": list(self.spacing)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        low, high = values["spacing"]
        return cls(values["quantile"], values["scenes"], Effort(**values["effort"]), (low, high))

    def band(self, answer: Answer, effort: Effort, notes: Sequence[str]) -> np.ndarray | None:
        """[S] how far from the truth a free node may be in each frame; None, and a warning that says why, where nothing
        is known: with another effort, for a scene with `notes`, on another mesh."""
        spacing = spacing_of(answer.scene)
        low, high = self.spacing
        if effort != self.effort:
            why = f"the run was calibrated with {self.effort.text}"
        elif notes:
            why = "the scene lies outside the ranges of the training"
        elif not (1 - LEEWAY) * low <= spacing <= (1 + LEEWAY) * high:
            why = f"the mesh edges are {spacing:.3g} long, in the calibration scenes {low:.3g} to {high:.3g}"
        else:
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
    width = quantile(scores)
    if math.isinf(width):
        raise ConfigError(f"{scores.count(math.inf)} of {len(scores)} predictions failed: no band holds")
    return Calibration(width, len(scores), run.effort, (min(spacings), max(spacings))), left_out
