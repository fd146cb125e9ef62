"""What a study measures of a trained run, as the result file of the study has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from statistics import fmean
from typing import Any, Self

from ast_sim.figures import Figures, MeanError


@dataclass(frozen=True)
class PhaseError:
    """The error of the displacement in a phase of contact, in the two conventions of evaluations."""

    rmse_sequence: float
    rmse_pooled: float


@dataclass(frozen=True)
class MeasuredRun:
    """A run on the test scenes.

    Attributes:
        figures: its evaluation.
        parameters: of its model.
        phases: the errors by phase of contact; a phase without frames is left out.
        horizons: how many times the length of a scene its long rollout has.
        diverged: what stopped a long rollout, by scene.
        farthest: the largest distance in all long rollouts from the centre of the domain, over the one in the truth.
    """

    figures: Figures
    parameters: int
    phases: Mapping[str, PhaseError]
    horizons: int
    diverged: Mapping[str, str]
    farthest: float

    def error(self, quantity: str, predictor: str = "model", horizon: str = "rollout_all") -> MeanError:
        """The error over all test scenes; None in it: there is none."""
        none = MeanError(quantity, predictor, horizon, "", None, None)
        return self.figures.error(quantity, predictor, horizon) or none

    def phase_error(self, phase: str) -> float | None:
        """The error of the displacement in a phase of contact, by sequence; None: it has no frames."""
        error = self.phases.get(phase)
        return None if error is None else error.rmse_sequence

    def seconds_per_step(self) -> float | None:
        """The mean over the test scenes of the seconds of a frame; None: a prediction failed."""
        seconds = [scene.model_seconds_per_step for scene in self.figures.scenes]
        known = [value for value in seconds if value is not None]
        return fmean(known) if len(known) == len(seconds) else None

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """From what `to_json` gave."""
        own = {one.name: values[one.name] for one in fields(cls) if one.name != "figures"}
        own["phases"] = {name: PhaseError(**error) for name, error in own["phases"].items()}
        return cls(Figures.from_json({key: value for key, value in values.items() if key not in own}), **own)

    def to_json(self) -> dict[str, Any]:
        """Dictionaries, lists, texts and numbers; the figures stand beside the rest."""
        own = asdict(self)
        del own["figures"]
        return {**self.figures.to_json(), **own}
