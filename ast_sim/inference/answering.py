"""Answers to questions, by jumps or step by step. A scene that lies elsewhere is moved to where training scenes lay."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import numpy as np

from ast_sim.inference.answer import Answer
from ast_sim.inference.effort import FIRST_CALL, Effort
from ast_sim.inference.predicting.jump import jumps
from ast_sim.inference.predicting.question import Question
from ast_sim.inference.predicting.rollout import rollouts
from ast_sim.mechanics.physics_check import turned_over
from ast_sim.models.data_facts import DataFacts
from ast_sim.models.simulator import Simulator
from ast_sim.ops import products_in
from ast_sim.runs.scope import LEEWAY, middle_of, size_of
from ast_sim.scene import Scene
from ast_sim.support.errors import counted
from ast_sim.support.progress import ShowProgress


def answers(
    model: Simulator,
    questions: Sequence[Question],
    effort: Effort = FIRST_CALL,
    progress: ShowProgress = False,
) -> list[Answer]:
    """Predict the wanted frames of several scenes, by jumps or step by step as the model does; see `jumps` and
    `rollouts` for the arguments and errors.

    Scenes are predicted where training scenes lay, since some models read positions, and the answers are given where
    the scenes lie. A scene that leaves the domain even so is predicted in the middle of the domain.
    """
    began = time.perf_counter()
    shifts = [_shift_to_known_place(model.config.data, question) for question in questions]
    there = [q if shift is None else _moved_question(q, shift) for q, shift in zip(questions, shifts, strict=True)]
    with products_in(effort.precision):
        if model.config.scheme.jumps:
            predicted = jumps(model, there, effort, progress)
        else:
            effort.check(model.config)
            predicted = rollouts(model, there, progress)
    back = [
        answer if shift is None else _moved_back(question, answer, shift)
        for question, shift, answer in zip(questions, shifts, predicted, strict=True)
    ]
    each = (time.perf_counter() - began) / max(1, len(questions))
    return [dataclasses.replace(answer, seconds=each) for answer in back]


def doubts(answer: Answer) -> list[str]:
    """What speaks against an answer, whatever the question was: Newton steps that have not converged, and elements of
    deforming bodies that are turned over."""
    told = []
    if answer.converged is False:
        told.append(
            f"the Newton steps have not converged: the last one has a size of {max(answer.last_steps):.2g}"
            " (Answer.last_steps)"
        )
    return [*told, *impossible(answer)]


def impossible(answer: Answer) -> list[str]:
    """The elements of deforming bodies that are turned over, in the first frame that has some, as a sentence."""
    counts = (turned_over(answer.scene, position) for position in answer.position)
    first = next(((frame, count) for frame, count in zip(answer.frames, counts, strict=False) if count), None)
    if first is None:
        return []
    frame, count = first
    over = counted(int(count), "element is", "elements are")
    return [f"{over} turned over in frame {frame}, which no body can do (Answer.check)"]


def _moved_question(question: Question, shift: np.ndarray) -> Question:
    scene = dataclasses.replace(question.scene, rest_position=_moved(question.scene.rest_position, shift))
    return dataclasses.replace(question, scene=scene, prescribed_position=_moved(question.prescribed_position, shift))


def _moved_back(question: Question, answer: Answer, shift: np.ndarray) -> Answer:
    position = _moved(answer.position, -shift)
    given = question.prescribed_position[list(answer.frames)]
    # Given numbers stay what they are, to the last bit.
    known = question.scene.prescribed | ~answer.computed[:, None]
    position = np.where(known[:, :, None], given, position)
    return dataclasses.replace(answer, scene=question.scene, position=position)


def _shift_to_known_place(data: DataFacts, question: Question) -> np.ndarray | None:
    """[3] float64: from where the scene lies to a place that the model knows; None: the scene lies there."""
    shift = _shift_to_training(data, question.scene)
    position = question.prescribed_position
    known = np.concatenate([position[0], position[:, question.scene.prescribed].reshape(-1, 3)])
    known = known.T.astype(np.float64, order="C")  # rows are reduced faster
    lowest, highest = known.min(axis=1) + shift, known.max(axis=1) + shift
    center = np.array(data.domain_center)
    if max((center - lowest).max(), (highest - center).max()) > data.domain_half_width:
        shift += center - (lowest + highest) / 2
    return shift if shift.any() else None


def _shift_to_training(data: DataFacts, scene: Scene) -> np.ndarray:
    """[3] float64: the shortest shift to where training scenes lay; zeros if the scene lies there, nearly enough."""
    if not data.middle_low:
        return np.zeros(3)
    middle = middle_of(scene)
    shift = np.clip(middle, data.middle_low, data.middle_high) - middle
    return shift if np.abs(shift).max() > LEEWAY * size_of(scene) else np.zeros(3)


def _moved(points: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Points [..., 3] float32, moved by `shift` [3] float64 and rounded once."""
    return (points.astype(np.float64) + shift).astype(np.float32)
