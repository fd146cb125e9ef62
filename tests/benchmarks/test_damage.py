"""The count of what damaged files do, on few damages; and with a guard taken away it finds what is silent."""

import pytest
import torch

from ast_sim.runs import checkpoint
from benchmarks.robustness import damage


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield damage.Bench(tmp_path_factory.mktemp("damage"))
    torch.set_num_threads(threads)


def test_damages_are_drawn_from_all_files_in_turn(bench):
    drawn = list(damage.damages(bench.intact, 400, 100, seed=3))
    assert drawn == list(damage.damages(bench.intact, 400, 100, seed=3))
    assert [d.group for d in drawn[:5]] == list(damage.GROUPS)
    assert sum(d.bit is None for d in drawn) == 100
    files = {d.file for d in drawn}
    assert {"data.h5", "run/run.json", "run/metrics.jsonl", "run/checkpoints/step-1/state.json"} <= files
    assert all(0 <= d.place < (bench.intact / d.file).stat().st_size for d in drawn)


def test_few_damages_are_told(bench):
    found = [bench.outcome(d)[0] for d in damage.damages(bench.intact, 15, 5, seed=1)]
    assert set(found) <= {"same", "warned", "refused"} and found.count("same") < 5


def test_what_was_expected_has_no_times_but_all_numbers(bench):
    expected = bench.expected[damage.EVALUATE]
    assert not any("model_seconds" in key for key in expected)
    assert any("solver_seconds" in key for key in expected) and any("rmse_pooled" in key for key in expected)
    assert sum(key.startswith("run/checkpoint") or "step-3" in key for key in bench.expected[damage.TRAIN]) == 4


def test_without_a_guard_other_numbers_are_silent_and_an_exception_is_a_traceback(bench, monkeypatch):
    weights = damage.Damage("checkpoints", "run/checkpoints/step-2/model.safetensors", 9000, 6)
    assert bench.outcome(weights)[0] in ("warned", "refused")

    def unguarded(path):
        return {name: (path / name).read_bytes() for name in checkpoint.FILES}

    monkeypatch.setattr(checkpoint, "_read_verified", unguarded)
    assert bench.outcome(weights)[0] == "silent"
    monkeypatch.setattr(checkpoint, "_ERRORS", ())
    header = damage.Damage("checkpoints", "run/checkpoints/step-2/model.safetensors", 3, None)
    outcome, text = bench.outcome(header)
    assert outcome == "traceback" and "SafetensorError" in text
