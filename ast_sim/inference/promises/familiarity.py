"""Is a scene like the scenes that a run knows? How far what the network makes of it lies from the calibration scenes.

A frame is known by the mean x [D] of its latent rows in the first call: tokens of AST, nodes of other models. With the
means m and the standard deviations s of all frames of the calibration scenes, let z = (x - m) / s, and let C be the
covariance of z. The distance of a frame is the Mahalanobis distance, with a ridge, since D may exceed the frames:

    d(x)^2 = z^T (C + RIDGE I)^-1 z = |W (x - m)|^2,   W = L^-1 diag(1 / s),   L L^T = C + RIDGE I.

The score of a calibration scene is the largest distance of its frames, by m, s and C of the other scenes. Of n scores
let k be at least as large as the distance of a new scene. Its p-value is (1 + k) / (n + 1): a new scene of the same
kind has p <= a in a share a of all cases at most, but for the small change of W by one scene (conformal: Vovk,
Gammerman, Shafer 2005).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ast_sim.support.errors import counted

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer

RIDGE = 0.1  # of the variance of each component; 0.01 tells the same scenes apart
UNUSUAL = 0.05  # a p-value up to which a scene is called unlike the calibration scenes
DIGITS = 6  # that are kept of each number


@dataclass(frozen=True)
class Familiarity:
    """The calibration scenes as the network sees them.

    Attributes:
        center: [D], m.
        metric: the rows of W [D, D], each up to the diagonal.
        scores: of the n calibration scenes.
    """

    center: tuple[float, ...]
    metric: tuple[tuple[float, ...], ...]
    scores: tuple[float, ...]

    @classmethod
    def of(cls, scenes: Sequence[np.ndarray]) -> Self:
        """From the latent means [frames, D] of each of at least three scenes."""
        scores = []
        for number, scene in enumerate(scenes):
            others = np.concatenate([*scenes[:number], *scenes[number + 1 :]])
            scores.append(_distances(scene, *_fitted(others)).max())
        center, metric = _fitted(np.concatenate(scenes))
        rows = tuple(_rounded(row[: number + 1]) for number, row in enumerate(metric))
        return cls(_rounded(center), rows, _rounded(scores))

    def p_value(self, answer: Answer) -> float | None:
        """How usual the scene of an answer is, between 1 / (n + 1) and 1, by the computed frame in which the prescribed
        nodes are farthest from their places at rest. None: the answer has no such frame."""
        if not answer.latents:
            return None
        travel = np.linalg.norm(answer.displacement[:, answer.scene.prescribed], axis=2).max(axis=1, initial=0.0)
        farthest = max(answer.latents, key=lambda number: travel[answer.frames.index(number)])
        center, metric, scores = self._arrays
        distance = _distances(answer.latents[farthest][None], center, metric)[0]
        return float((1 + np.sum(scores >= distance)) / (len(scores) + 1))

    @cached_property
    def _arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """m [D], W [D, D] and the scores [n]; every answer needs them."""
        metric = np.zeros((len(self.center), len(self.center)))
        for number, row in enumerate(self.metric):
            metric[number, : number + 1] = row
        return np.array(self.center), metric, np.array(self.scores)

    def notes(self, p_value: float) -> tuple[str, ...]:
        """A sentence for a scene that is unlike the calibration scenes; none for others."""
        if p_value > UNUSUAL:
            return ()
        count = len(self.scores)
        larger = count + 1 - round(p_value * (count + 1))
        return (
            f"the network finds the scene more unusual than {larger} of {counted(count, 'calibration scene')} (p ="
            f" {p_value:.2g}): neither a band nor an error is promised",
        )

    def to_json(self) -> dict[str, Any]:
        """As `from_json` reads it."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        return cls(tuple(values["center"]), tuple(map(tuple, values["metric"])), tuple(values["scores"]))


def _fitted(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """m [D] and W [D, D] of frames [F, D]."""
    center, spread = frames.mean(axis=0), frames.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    covariance = np.cov((frames - center) / spread, rowvar=False)
    lower = np.linalg.cholesky(np.atleast_2d(covariance) + RIDGE * np.eye(len(center)))
    return center, np.linalg.inv(lower) / spread


def _distances(frames: np.ndarray, center: np.ndarray, metric: np.ndarray) -> np.ndarray:
    """[F] the distances of frames [F, D]."""
    return np.linalg.norm((frames - center) @ metric.T, axis=1)


def _rounded(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(f"{value:.{DIGITS}g}") for value in values)
