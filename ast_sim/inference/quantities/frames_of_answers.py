"""The frames that an answer has: their times, and an error where there are none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ast_sim.support.errors import RolloutError

if TYPE_CHECKING:
    from ast_sim.inference.answer import Answer


def time_of(answer: Answer, number: int) -> float | None:
    """The time of a frame in seconds: the one that the question gave, else by the time step of the data; or None."""
    if number in answer.times or answer.info is None:
        return answer.times.get(number)
    times = answer.info.times((number,))
    return None if times is None else times[0]


def require_frames(answer: Answer, purpose: str) -> None:
    """Raise RolloutError if the answer has no frame; the text names what it is for, and why there is none."""
    if not answer.frames:
        why = "" if answer.failure is None else f": {answer.failure}"
        raise RolloutError(f"{answer.name}: the answer has no frame to {purpose}{why}", answer)
