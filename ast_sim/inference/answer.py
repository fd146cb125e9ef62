"""The answer of a trained model: a predicted trajectory."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ast_sim.dataset.layout import DatasetInfo
from ast_sim.dataset.writer import DatasetWriter
from ast_sim.inference.quantities.answered_frame import AnsweredFrame
from ast_sim.inference.quantities.band import Band, band_of, bands_of, how_far
from ast_sim.inference.quantities.facts_of_answers import facts_of
from ast_sim.inference.quantities.forces_and_figures import (
    BodyForce,
    figures_of,
    force_on,
    forces_on_bodies,
    sets_of_answer,
    write_figures,
    write_forces,
)
from ast_sim.inference.quantities.frames_of_answers import require_frames, time_of
from ast_sim.inference.quantities.relative_errors import errors_of, require_same_motion
from ast_sim.mechanics.driven import Driven
from ast_sim.mechanics.linearised.linearised_contact import STILL
from ast_sim.mechanics.permanent_set import PermanentSet
from ast_sim.mechanics.physics_check import Law, PhysicsCheck, check_physics
from ast_sim.named_field import NamedField
from ast_sim.scene import AttributeValue, Scene, Trajectory
from ast_sim.support.argument_checks import file_name
from ast_sim.support.errors import AstSimError, MissingExtra, RolloutError
from ast_sim.support.notebook_table import html_picture, html_table, one_line
from ast_sim.support.toml_settings import required_whole
from ast_sim.view import export, picture
from ast_sim.view.files import make_folder

if TYPE_CHECKING:
    import pyvista
    from matplotlib.figure import Figure

SUFFIXES = (".h5", ".pvd", ".vtkhdf", ".csv")


@dataclass(frozen=True, eq=False)
class Answer:
    """The S wanted frames of a prediction, in the order in which they were named. After a failure some are missing.

    Attributes:
        name, scene: of the question.
        position: [S, N, 3] float32, in the run's unit of length.
        stress: [S, N or E, 1] float32 in pascal, or None. A given frame holds the given stress, or zero without one.
        given: how many first frames of the motion were given: 1, or 2 in dynamic scenes.
        step_seconds: wall seconds of each computed frame, in ascending order; frames of one batch share its time.
        failure: why the prediction ended early, naming the frame and the node; None if it did not.
        info: the units and the kind of the data; it is written into files of the answer.
        source: the origin of the answer: attributes that `trajectory` gets.
        stress_location: where the rows of the stress are: "node" or "element".
        frames: the numbers of the S frames in the motion of the question.
        seconds: the wall seconds from call to answer, also for the mesh; scenes predicted together share them.
        notes: what is unusual about the scene for the run, as sentences; they are warnings as well.
        latents: what the network made of each computed frame, [D] by number (`familiarity`).
        p_value: how usual the scene is beside the calibration scenes, up to 1; a note tells one of 0.05 or less.
        expected_error: the mean relative error of the displacement of validation scenes, at their deepest frame, with
            the same effort, and no bound for this scene. None: it was not measured, there are notes, or it failed.
        last_steps: of each computed frame, in ascending order, the size of its last Newton step (`NewtonSteps.size`);
            a next step would be about its square. 0 after the solver; empty without Newton steps.
        driven: the prescribed nodes that move farthest together in the whole motion.
        law: the law of the material and of contact, as the run knows it.
        fields: the named fields that the model predicts, [S, N or E, *] each with its unit; a given frame holds zero,
            or what was given. Newton steps leave "reaction" out, since forces then follow from positions (`reaction`,
            `body_forces`); they do not change the others.
        bands: of each quantity, as `band` takes them.
        times: the seconds of frames by number, where the question has times; else they follow from `info`.
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
    seconds: float = 0.0
    notes: tuple[str, ...] = ()
    expected_error: float | None = None
    last_steps: tuple[float, ...] = ()
    driven: Driven | None = None
    law: Law | None = None
    bands: Mapping[str, Band] = field(default_factory=dict)
    fields: dict[str, NamedField] = field(default_factory=dict)
    latents: dict[int, np.ndarray] = field(default_factory=dict)
    p_value: float | None = None
    times: Mapping[int, float] = field(default_factory=dict)

    @property
    def how_far(self) -> list[str]:
        """What is known of the distance to the truth, as sentences."""
        return how_far(self)

    @property
    def computed(self) -> np.ndarray:
        """[S] bool: the frames that were predicted, not given."""
        return np.array(self.frames, np.int64) >= self.given

    def __repr__(self) -> str:
        return one_line("Answer", facts_of(self))

    def _repr_html_(self) -> str:
        try:
            file = io.BytesIO()
            self.plot().savefig(file, format="png", dpi=96)
            return html_table("Answer", facts_of(self), html_picture(file.getvalue(), 400))
        except (MissingExtra, RolloutError):  # a table is better than nothing
            return html_table("Answer", facts_of(self))

    @property
    def displacement(self) -> np.ndarray:
        """[S, N, 3]: the displacements from the positions at rest, in the run's unit of length."""
        return self.position - self.scene.rest_position

    def frame(self, number: int) -> AnsweredFrame:
        """The frame with this number in the motion of the question, which counts from 0; none counts from the end.

        Raises:
            ConfigError, RolloutError: it is no whole number; or the answer lacks it, and the text says what it has.
        """
        if required_whole(number=number)[0] not in self.frames:
            known = ", ".join(map(str, self.frames[:20])) + (", ..." if len(self.frames) > 20 else "")
            from_end = "; a negative number does not count from the end here" if number < 0 else ""
            told = f"the answer has no frame {number}; it has: {known or 'none'}{from_end}"
            raise RolloutError(f"{self.name}: {told}", self)
        return self._frame(self.frames.index(number))

    def _frame(self, row: int) -> AnsweredFrame:
        return AnsweredFrame(
            self.frames[row],
            time_of(self, self.frames[row]),
            self.position[row],
            self.position[row] - self.scene.rest_position,
            None if self.stress is None else self.stress[row, :, 0],
            {name: one.values[row] for name, one in self.fields.items()},
        )

    def __iter__(self) -> Iterator[AnsweredFrame]:
        """The frames, in the order in which they were named."""
        return map(self._frame, range(len(self.frames)))

    def plot(self, number: int | None = None) -> Figure:
        """A picture of one frame, coloured by stress, or by displacement if the model predicts no stress.

        Args:
            number: the number of the frame; by default the one in which the deforming bodies are displaced most.

        Returns:
            A matplotlib figure: `answer.plot().savefig("answer.png")`.

        Raises:
            RolloutError: the answer has no such frame.
            MissingExtra: matplotlib is not installed.
        """
        require_frames(self, "draw")
        shown = self.trajectory
        row = picture.farthest(shown) if number is None else shown.numbers.index(self.frame(number).number)
        return picture.plot(shown, row, self.name, shown.length_unit or "m")

    def to_pyvista(self, number: int | None = None) -> pyvista.UnstructuredGrid:
        """One frame as a grid of PyVista, with the fields of a file for ParaView.

        Args:
            number: the number of the frame; by default the last one of the motion that the answer has.

        Raises:
            RolloutError: the answer has no such frame.
            MissingExtra: pyvista is not installed: pip install "ast_sim[pyvista]".
        """
        chosen = self.frame(max(self.frames, default=0) if number is None else number).number
        return export.to_pyvista(self.trajectory.select([chosen]))

    @property
    def converged(self) -> bool | None:
        """Whether the last Newton step of every frame was at most 0.05; None without Newton steps. The stop test of
        the solver, which is about forces (`check`), is stricter: `Effort.exact` goes on to it."""
        return max(self.last_steps) <= STILL if self.last_steps else None

    @property
    def trajectory(self) -> Trajectory:
        """The answer as a trajectory, in ascending order of the frames. Attributes: origin, notes, bands, given frames,
        seconds."""
        order = np.argsort(self.frames, kind="stable")
        frames = tuple(self.frames[row] for row in order)
        attributes = {
            "status": "complete" if self.failure is None else "truncated",
            **self.source,
            **({"notes": "; ".join(self.notes)} if self.notes else {}),  # a file is read without the warnings
            **{name: band[order].tolist() for name, band in bands_of(self).items()},
            "given_frames": self.given,
            "model_seconds": list(self.step_seconds),
            **({"last_newton_steps": list(self.last_steps)} if self.last_steps else {}),
        }
        return Trajectory(
            self.scene,
            self.position[order],
            None if self.stress is None else self.stress[order],
            attributes,
            stress_location=None if self.stress is None else self.stress_location,
            frames=frames,
            times=tuple(time for number in frames if (time := time_of(self, number)) is not None) or None,
            length_unit=None if self.info is None else self.info.length_unit,
            fields={name: one.select(order.tolist()) for name, one in self.fields.items()},
        )

    def reaction(self, nodes: np.ndarray | Sequence[int] | None = None) -> np.ndarray:
        """[S, 3] the force in newton on prescribed nodes.

        Args:
            nodes: [N] bool, or numbers: the nodes, such as the held end of a part; None: `driven`.

        If the answer has nodal reactions (`fields["reaction"]`), it is their sum. Without them, as after Newton steps,
        it follows from the strains of the positions, if the law of the material is known and elastic: the law of
        the bundled solver. Where Newton steps have ended, what touches held nodes beside free ones counts, too.

        Raises:
            ConfigError: there is none; the text says why: no prescribed node moves; or the scene has inertia or no
                tetrahedra, or the law of its material is not known, and the model predicts no reactions. Or a node is
                free or no node of the scene; or some nodes of a rigid body are left out, where forces follow from
                positions.
        """
        return force_on(self, nodes)

    def band(self, quantity: str = "displacement") -> np.ndarray | None:
        """[S] how far from the truth the answer may be, with a probability of 95 % in all frames at once
        (`calibration`); None: the run was not calibrated, or a warning has said why, or the scene has no such quantity.

        Args:
            quantity: "displacement": of all free nodes, in the unit of length; "reaction": of the force on `driven`, in
                newton; "stress": of the largest stress, in pascal.

        Raises:
            ConfigError: there is no such quantity; or it is a force, and elements of the data keep their corners only.
        """
        return band_of(self, quantity)

    def errors(self, truth: Trajectory) -> dict[str, float]:
        """Relative errors where a simulation is known: in the deepest frame, the one of the predicted frames that both
        have in which the simulation is displaced most.

        Args:
            truth: a simulation of the same motion, which has frame 0.

        Returns:
            "displacement": the root mean square error of the free nodes over the root mean square displacement;
            "reaction": the distance of the forces on the moved body over the true force; "stress": by how much the
            largest stress is off, over the true one. The last two are missing where there is none, or it is 0.

        Raises:
            AstSimError: the truth is of another scene, motion or unit; they share no frame; or nothing is displaced.
        """
        return errors_of(self, truth)

    def body_forces(self) -> list[BodyForce]:
        """The force and the torque on the prescribed nodes of each body that has some, frame by frame, by the law or by
        predicted reactions as in `reaction`.

        Raises:
            ConfigError: as in `reaction`.
        """
        return forces_on_bodies(self)

    def save_forces(self, path: str | os.PathLike[str]) -> None:
        """Write `body_forces` as a table (.csv): frame, time, body, force_x, ... [N], torque_x, ... [N m]; and where
        there is a `permanent_set`, its largest and its mean displacement in the row of its frame and body.

        Raises:
            ConfigError: as in `reaction`.
            AstSimError: there is no frame, the suffix is another one, or the file cannot be written.
        """
        require_frames(self, "save")
        write_forces(file_name(path, "path"), self.body_forces(), self.permanent_set())

    def permanent_set(self) -> list[PermanentSet]:
        """The displacement that is left in each body that yields, if all prescribed nodes are back at rest in the last
        frame of the answer; else none. A body that is held while other nodes of it are driven is not let go: it has
        none. A body yields if its material has a yield stress; if the data have none, if its predicted plastic strain
        (PEEQ) exceeds 0.2 %."""
        return sets_of_answer(self)

    def check(self) -> PhysicsCheck:
        """Is it physics? Elements turned over, penetration, the forces out of balance: the worst over the computed
        frames, each with a sentence. It takes about as long as a Newton step for each frame, and no truth.

        Returns:
            What was found; `print(answer.check())` shows a table. Forces need the law of the material.
        """
        unit = "" if self.info is None else self.info.length_unit
        rows = np.flatnonzero(self.computed)
        return check_physics(self.scene, self.position[rows], [self.frames[row] for row in rows], self.law, unit)

    def figures(self, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> list[dict[str, float]]:
        """What an engineer asks of each frame: the travel of the prescribed nodes, the reaction and its components (if
        `reaction` knows it), the largest stress and where it is (if the model predicts one), the largest number of
        each named field (of several columns: the largest norm), the largest `permanent_set` (in the last frame, if
        there is one), the size of the last Newton step (if any was made), and each `band` (`displacement_band`,
        `reaction_band`, `largest_stress_band`).

        Args:
            origin: [3] the point that positions are relative to.
        """
        bands = {name: band.tolist() for name, band in bands_of(self).items()}
        rows = enumerate(figures_of(self, origin))
        return [figures | {name: band[row] for name, band in bands.items()} for row, figures in rows]

    def save(self, path: str | os.PathLike[str], truth: Trajectory | None = None) -> None:
        """Write the answer as a dataset (.h5), as a file for ParaView (.pvd, .vtkhdf), or its `figures` (.csv).

        Args:
            truth: the true trajectory, if it is known; a file for ParaView then holds the errors, too.

        Raises:
            AstSimError: there is no frame; suffix or motion of the truth is another one; the file cannot be written.
        """
        require_frames(self, "save")
        path = file_name(path, "path")
        if path.suffix not in SUFFIXES:
            raise AstSimError(f"{path}: the name of a prediction must end in one of {', '.join(SUFFIXES)}")
        require_same_motion(self, truth, self.frames)
        if self.info is None:
            raise AstSimError(f"{path}: this answer has no units: save one of Run.predict or Run.evaluate")
        make_folder(path.parent)
        if path.suffix == ".h5":
            with DatasetWriter(path, self.info) as writer:
                writer.add("test", self.trajectory)
        elif path.suffix == ".csv":
            write_figures(path, self)
        else:
            export.write(path, *((self.trajectory,) if truth is None else (truth, self.trajectory)))
