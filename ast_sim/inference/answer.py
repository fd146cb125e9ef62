"""The answer of a trained model: a predicted trajectory."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.scene import AttributeValue, Scene, Trajectory
from ast_sim.support.errors import AstSimError
from ast_sim.view import export
from ast_sim.view.files import make_folder

SUFFIXES = (".h5", ".pvd", ".vtkhdf")


@dataclass(frozen=True, eq=False)
class Answer:
    """The S wanted frames of a prediction. The first `given` of them were given; after a failure some are missing.

    Attributes:
        name: name of the scene, for messages.
        scene: the scene that was predicted.
        position: [S, N, 3] float32, in the run's unit of length.
        stress: [S, N or E, 1] float32 in pascal, or None. A given frame holds the given stress, or zero without one.
        given: number of given frames among them: of all frames 1, or 2 in dynamic scenes.
        step_seconds: wall seconds of each frame that was computed; the frames of one batch share its time equally.
        failure: why the prediction ended early, naming the frame and the node; None if it did not.
        info: the units and the kind of the data; it is written into files of the answer.
        source: the origin of the answer: attributes that `trajectory` gets.
        stress_location: where the rows of the stress are: "node" or "element".
        frames: the numbers of the S frames in the motion that was asked.
    """

    name: str
    scene: Scene
    position: np.ndarray
    stress: np.ndarray | None
    given: int
    step_seconds: list[float]
    failure: str | None = None
    info: DatasetInfo | None = None
    source: dict[str, AttributeValue] = field(default_factory=dict)
    stress_location: str | None = None
    frames: tuple[int, ...] = ()

    @property
    def seconds(self) -> float:
        """Wall seconds of the whole prediction."""
        return sum(self.step_seconds)

    @property
    def trajectory(self) -> Trajectory:
        """The answer as a trajectory; its attributes hold the origin, the given frames and the seconds."""
        attributes = {
            "status": "complete" if self.failure is None else "truncated",
            **self.source,
            "given_frames": self.given,
            "frames": list(self.frames),
            "model_seconds": list(self.step_seconds),
        }
        location = None if self.stress is None else self.stress_location
        return Trajectory(self.scene, self.position, self.stress, attributes, stress_location=location)

    def save(self, path: str | os.PathLike[str], truth: Trajectory | None = None) -> None:
        """Write the answer as a dataset (.h5) or as a file for ParaView (.pvd, .vtkhdf).

        Args:
            truth: the true trajectory, if it is known; a file for ParaView then holds the errors, too.

        Raises:
            AstSimError: the suffix is another one, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix not in SUFFIXES:
            raise AstSimError(f"{path}: the name of a prediction must end in one of {', '.join(SUFFIXES)}")
        if self.info is None:
            raise AstSimError(f"{path}: this answer has no units: save one of Run.predict or Run.evaluate")
        make_folder(path.parent)
        if path.suffix == ".h5":
            with DatasetWriter(path, self.info) as writer:
                writer.add("test", self.trajectory)
        else:
            shown = (self.trajectory, None) if truth is None else (truth, self.trajectory)
            export.write(path, *shown, time_step=self.info.time_step or 1.0)
