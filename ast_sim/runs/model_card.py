"""The card of a model: what it predicts, for which scenes, how well, and how it was trained."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import ast_sim
from ast_sim.number_arrays import percent
from ast_sim.runs.folder import Chosen
from ast_sim.runs.scope import Scope
from ast_sim.runs.train_config import RunConfig

_TEXT = """# {name}

A trained model of `ast_sim` {version}. It predicts how deforming bodies in contact move, for scenes like its training
scenes (family `{family}`, lengths in {unit}). It warns of a scene outside the ranges below. {familiar}

```
import ast_sim

run = ast_sim.Run("{name}.ast")
answer = run.predict(scene, motion)
```

## Training scenes

| | from | to |
| --- | ---: | ---: |
{ranges}

## Errors on validation scenes

{errors}

## Training

| | |
| --- | --- |
{training}

The terms of use are in `LICENSE`.
"""


def card(name: str, settings: RunConfig, scope: Scope, chosen: Chosen, parameters: int) -> str:
    """The card as Markdown; `parameters` is their number."""
    model = settings.model
    train = settings.train
    training = {
        "model": f"{model.name}, {parameters:,} parameters",
        "checkpoint": f"step {chosen.step:,} of {train.steps:,}",
        "scenes in a step": train.batch_size * train.accumulate,
        "optimizer": f"{train.optimizer}, peak rate {train.peak_rate:.3g}",
        "seed": train.seed,
        "dataset": settings.data,
        "inertia": "yes" if model.data.dynamic else "no",
        "stress": {"none": "not predicted", "node": "at nodes", "element": "in elements"}[model.data.stress],
        "named fields": ", ".join(model.state) or "none",
    }
    return _TEXT.format(
        name=name,
        version=ast_sim.__version__,
        family=scope.family,
        unit=scope.length_unit,
        familiar=_familiar(chosen.answers.get("calibration")),
        ranges="\n".join(f"| {what} | {low:.4g} | {high:.4g} |" for what, low, high in _ranges(scope)),
        errors=_errors(chosen.answers),
        training="\n".join(f"| {what} | {value} |" for what, value in training.items()),
    )


def _familiar(calibration: Mapping[str, Any] | None) -> str:
    """What the run tells of shapes and motions that it does not know."""
    if calibration is None or calibration["familiarity"] is None:
        return "It does not check the\nshapes of bodies: for other shapes its answer is wrong without a warning."
    scenes = calibration["scenes"]
    return f"It also warns if its network\nfinds a scene unlike the {scenes} scenes with which it was calibrated."


def _ranges(scope: Scope) -> Iterator[tuple[str, float, float]]:
    unit = scope.length_unit
    yield "nodes", *scope.nodes
    yield f"size of the deforming bodies [{unit}]", *scope.size
    yield f"mesh spacing [{unit}]", *scope.spacing
    yield "extent of the held nodes, as a share of the size", *scope.held
    yield f"travel of prescribed nodes [{unit}]", *scope.travel
    for axis, low, high in zip("xyz", scope.motion_low, scope.motion_high, strict=True):
        yield f"displacement of prescribed nodes along {axis} [{unit}]", low, high
    for name, limits in scope.material_ranges.items():
        yield f"{name} of the material", *limits


def _errors(answers: Mapping[str, Any]) -> str:
    """A table of the efforts that validation measured; the default one is marked."""
    measured = [one for one in answers.get("valid_by_effort", []) if one["error"] is not None]
    if not measured:
        return "No validation measured the errors of single answers."
    efforts = [one["effort"] for one in measured]
    dials = [dial for dial in efforts[-1] if any(type(effort.get(dial)) is int for effort in efforts)]
    lines = [
        "Relative to the displacement, at the deepest frame; `newton_steps` are the most that were made. `*` marks the"
        " effort that the model takes by default.",
        "",
        f"| {' | '.join(f'`{dial}`' for dial in dials)} | error |",
        f"| {'---: | ' * len(dials)}---: |",
    ]
    for one in measured:
        mark = " *" if one["effort"] == answers.get("effort") else ""
        numbers = " | ".join(str(one["effort"].get(dial, "")) for dial in dials)
        lines.append(f"| {numbers}{mark} | {percent(one['error'], 3)} |")
    return "\n".join(lines)
