"""What a run keeps of its answers: the default effort, a calibration, and the errors that validation measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ast_sim.inference.effort import Effort, EffortErrors
from ast_sim.inference.promises.calibration import Calibration
from ast_sim.support.errors import CheckpointError
from ast_sim.support.precisions import PRECISIONS


def known_answers(
    path: Path, corrections: int, answers: Mapping[str, Any]
) -> tuple[Effort, Calibration | None, list[EffortErrors]]:
    """The default effort, by default `corrections` alone; the calibration, if there is one; and the errors by effort.

    Raises:
        CheckpointError: they cannot be read; the text names the run, `path`.
    """
    try:
        for leaf in _leaves(answers.get("valid_by_effort", [])):
            if isinstance(leaf, str) and leaf not in PRECISIONS:
                raise ValueError(f"{leaf!r} is no number")
        effort = Effort(**answers.get("effort", {"corrections": corrections}))
        measured = [EffortErrors.from_json(one) for one in answers.get("valid_by_effort", [])]
        return effort, Calibration.of_run(path, answers), measured
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{path}: what it keeps of its answers cannot be read: {error}") from error


def _leaves(values: Any) -> Iterator[Any]:
    if isinstance(values, Mapping | list):
        for value in values.values() if isinstance(values, Mapping) else values:
            yield from _leaves(value)
    else:
        yield values
