"""Questions about an assembly: its scene and its motion, from a specification and values of its parameters."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ast_sim.inference.spec_differences import differences
from ast_sim.prescribed_motion import Motion
from ast_sim.runs.scope import Scope
from ast_sim.scene import Scene
from ast_sim.simulate.families.assembly import scene_of
from ast_sim.simulate.own_assembly.grid import required_values
from ast_sim.simulate.own_assembly.parameters import Values, completed, recorded
from ast_sim.simulate.own_assembly.spec_reader import read_spec
from ast_sim.simulate.own_assembly.standing import reference
from ast_sim.support.errors import AstSimError, ConfigError, SimulationError, warn
from ast_sim.support.toml_settings import require_range, whole

NOT_TRAINED = "the run was not trained on a specification, so it is not known how this one differs from its training"


@dataclass(frozen=True, eq=False)
class AssemblyQuestion:
    """A scene of an assembly that is to be predicted.

    Attributes:
        scene, motion: as `Run.predict` takes them.
        values: the values of all parameters.
        origin: [3] the point that positions are relative to.
        notes: how it differs from the training, a sentence each.
    """

    scene: Scene
    motion: Motion
    values: Values
    origin: list[float]
    notes: tuple[str, ...]

    @property
    def facts(self) -> dict[str, Any]:
        """The attributes of an answer that tell of the assembly."""
        return {**recorded(self.values), "origin": self.origin}


def questions_of(
    spec: str | os.PathLike[str],
    rows: Sequence[Mapping[str, Any]],
    scope: Scope,
    trained: Mapping[str, Any] | None,
    frames: int | None = None,
    nodes: int | None = None,
) -> list[AssemblyQuestion | AstSimError]:
    """The scenes with these values of the parameters; in the place of a scene that cannot be made, why not. Equal
    scenes are one object, which is prepared once. A warning tells each of their notes.

    Args:
        spec: the file of the specification.
        rows: values by name; parameters that a row leaves out are in the middle of their ranges.
        scope: what the model was trained on.
        trained: the specification of the training, as `AssemblySpec.describe` gives it; None: there was none.
        frames: the number of frames of the motion; None: as in the specification.
        nodes: about how many nodes a scene has; None: by the sizes of the specification.

    Raises:
        ConfigError: the specification has a mistake, there is no such parameter, its unit is not the run's, or frames
            or nodes are no such number.
    """
    frames, nodes = whole(num_frames=frames, nodes=nodes)
    require_range("num_frames", frames, 2)
    require_range("nodes", nodes, 1)
    read = read_spec(spec)
    if read.unit != scope.length_unit:
        raise ConfigError(
            f"{Path(spec).name} has lengths in {read.unit}, but the run was trained in {scope.length_unit}"
        )
    shared = reference(read)
    questions: list[AssemblyQuestion | AstSimError] = []
    known = {}
    notes = {}
    for row in rows:
        values = completed(read.parameters, row)
        try:
            case = scene_of(read, values, nodes, read.frames if frames is None else frames, shared).case
        except (SimulationError, ConfigError) as error:
            questions.append(error)
            continue
        notes |= dict.fromkeys(case.notes())
        arrays = (case.scene.rest_position, case.scene.elements, case.scene.node_type, case.scene.material)
        scene = known.setdefault(tuple(np.asarray(array).tobytes() for array in arrays), case.scene)
        told = tuple(differences(read, values, trained)) if trained else (NOT_TRAINED,)
        motion = Motion(case.prescribed_position.astype(np.float32))
        questions.append(AssemblyQuestion(scene, motion, values, list(shared.origin), told))
    for note in notes:
        warn(note)
    return questions


def values_of_rows(spec: str | os.PathLike[str], rows: Sequence[Mapping[str, Any]]) -> list[Values]:
    """The values of all parameters in each row.

    Raises:
        ConfigError: the specification has a mistake, or a row names what is no parameter, or has a value that does not
            fit; the text says which row, where there are several.
    """
    read = read_spec(spec)
    values = []
    for number, row in enumerate(rows):
        try:
            values.append(completed(read.parameters, row))
        except ConfigError as error:
            where = f"row {number} (the first one is row 0): " if len(rows) > 1 else ""
            raise ConfigError(f"{where}{error}") from error
    return values


def one_question(
    spec: str | os.PathLike[str],
    parameters: Mapping[str, Any] | None,
    scope: Scope,
    trained: Mapping[str, Any] | None,
    frames: int | None,
    nodes: int | None,
) -> AssemblyQuestion:
    """The scene with these values of the parameters; None: all are in the middle of their ranges.

    Raises:
        ConfigError, SimulationError: as `questions_of`; or the scene cannot be made; the text names the values.
    """
    values = {} if parameters is None else required_values("parameters", parameters)
    (question,) = questions_of(spec, [values], scope, trained, frames, nodes)
    if isinstance(question, AstSimError):
        raise question
    return question
