"""What was measured of the answers of a run holds for the weights that it was opened with, and for no others."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

import torch

from ast_sim.support.errors import ConfigError, warn

if TYPE_CHECKING:
    from ast_sim.inference.trained_run import Run


class KnownWeights:
    """The weights of a model at one time."""

    def __init__(self, model: torch.nn.Module) -> None:
        self._model = model
        self._parameters = list(model.parameters())  # to go through the modules takes longer in every answer
        self._hash = weights_hash(model)
        self._versions = self._counted()

    def are_of(self, model: torch.nn.Module, by_content: bool = False) -> bool:
        """Whether a model has these weights. Without `by_content` they are compared only where torch has counted a
        change, which another object in the place of a parameter escapes, and so does `Parameter.data`."""
        if model is self._model and not by_content and self._counted() == self._versions:
            return True
        if weights_hash(model) != self._hash:
            return False
        self._versions = self._counted()
        return True

    def _counted(self) -> list[int]:
        return [0 if one.is_inference() else one._version for one in self._parameters]


def weights_hash(model: torch.nn.Module) -> str:
    """A hash of all weights and scales."""
    known = hashlib.sha256()
    for values in model.state_dict().values():
        known.update(values.contiguous().numpy().tobytes())
    return known.hexdigest()


def forget_other_weights(run: Run, by_content: bool = False) -> None:
    """Take from a run what was measured of its answers, with a warning, if its weights have changed since."""
    if (run.calibration or run.measured) and not run.weights.are_of(run.model, by_content):
        run.calibration = None
        run.measured = []
        run.folder.forget_answers()
        warn(f"the weights of {run.path} have changed since it was opened: no errors and no bands are known with these")


def require_known_weights(run: Run, verb: str) -> None:
    """Raise ConfigError if the weights have changed, since the files of the run hold the ones that were trained; `verb`
    says what is to be done with a run that has the new ones."""
    if not run.weights.are_of(run.model, by_content=True):
        raise ConfigError(
            f"the weights of {run.path} have changed since it was opened: save it (Run.save), and {verb} what is saved"
        )
