"""The most accurate effort that takes no longer than a wanted time, as measured on this machine.

The time of an effort depends on the processor, the threads, the nodes of the scene and the wanted frames. At the first
question of its kind each effort is made once to warm up and then timed. The times are kept in the user's cache folder,
outside the run, since they say nothing on another machine.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import time
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs
import torch

from ast_sim.inference.answering import answers
from ast_sim.inference.effort import Effort, choices
from ast_sim.inference.promises.known_weights import weights_hash
from ast_sim.number_arrays import measured_time
from ast_sim.support.argument_checks import in_short
from ast_sim.support.disk import write_json
from ast_sim.support.errors import AstSimError, ConfigError
from ast_sim.support.provenance import processor

if TYPE_CHECKING:
    from ast_sim.inference.predicting.question import Question
    from ast_sim.inference.trained_run import Run

LARGEST = 1e300  # milliseconds: every effort takes less
REPEATS = 3
SIMILAR = 0.1  # scenes whose numbers of nodes differ by at most this share take the same time


def effort_within(run: Run, question: Question, ms: float) -> tuple[Effort, str]:
    """The effort with the smallest error in the validation scenes, of all efforts that take at most `ms` milliseconds
    for such a question, and what is said of the choice.

    Raises:
        ConfigError: `ms` is no number above 0; the fastest takes longer; the run has one effort, since it predicts
            step by step; or no errors of its efforts were measured.
    """
    if not isinstance(ms, Real) or isinstance(ms, bool) or not ms > 0:
        raise ConfigError(f"ms is {in_short(ms)}; it must be a number above 0")
    try:
        ms = min(float(ms), LARGEST)
    except OverflowError:  # a whole number of more than 308 digits
        ms = LARGEST
    efforts = choices(run.settings.model, run.settings.train.corrections)
    errors = {effort: run.expected_error(effort) for effort in efforts}
    known = {effort: error for effort, error in errors.items() if error is not None}
    if not known:
        raise ConfigError(
            "ms chooses among efforts whose errors are known, and this run has none: it predicts step by step, or no"
            " validation has measured them"
        )
    times = _times(run, question, tuple(known))
    within = [effort for effort in known if times[effort] <= ms]
    if not within:
        fastest = min(times, key=lambda effort: times[effort])
        raise ConfigError(
            f"no effort takes at most {ms:g} ms on this machine: the fastest takes"
            f" {measured_time(times[fastest] / 1000)} for such a question, with {fastest.text}"
        )
    best = min(within, key=lambda effort: (known[effort], times[effort]))
    took = measured_time(times[best] / 1000)
    return best, f"the most accurate within {ms:g} ms: such a question took {took} on this machine"


def _times(run: Run, question: Question, efforts: tuple[Effort, ...]) -> dict[Effort, float]:
    """Milliseconds of each effort for such a question, from the cache or measured."""
    path = platformdirs.user_cache_path("ast_sim") / "milliseconds.json"
    kept = _read(path)
    # With the weights: Newton steps end earlier after a better model.
    where = f"{weights_hash(run.model)} on {processor()}, {torch.get_num_threads()} threads"
    frames = len(question.wanted())
    nodes = question.scene.num_nodes
    try:
        for one in kept.get(where, []):
            times = {Effort(**each["effort"]): float(each["ms"]) for each in one["times"]}
            if one["frames"] == frames and abs(one["nodes"] - nodes) <= SIMILAR * nodes and set(efforts) <= set(times):
                return times
    except (AstSimError, AttributeError, KeyError, TypeError):  # another version has written it
        del kept[where]
    times = {effort: _timed(run, question, effort) for effort in efforts}
    told = [{"effort": vars(effort), "ms": ms} for effort, ms in times.items()]
    kept.setdefault(where, []).append({"nodes": nodes, "frames": frames, "times": told})
    with contextlib.suppress(AstSimError):  # no home that can be written to: they are measured again the next time
        write_json(path, kept)
    return times


def _read(path: Path) -> dict[str, list[dict[str, Any]]]:
    """What was measured before; nothing, if the file is missing or damaged."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return kept if isinstance(kept, dict) else {}


def _timed(run: Run, question: Question, effort: Effort) -> float:
    """The median of the milliseconds of an answer, after one that does not count."""
    seconds = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        answers(run.model, [question], effort)
        seconds.append(time.perf_counter() - began)
    return 1000 * statistics.median(seconds[1:])
