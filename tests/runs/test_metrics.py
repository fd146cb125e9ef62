"""The lines of `metrics.jsonl`: which of several validations counts, and what becomes of damaged ones."""

import warnings

import pytest

from ast_sim.runs.metrics import Metrics
from ast_sim.support.errors import CheckpointError


def test_the_last_validation_of_a_step_counts(tmp_path):
    metrics = Metrics(tmp_path)
    for step, error, corrections in ((1, 0.3, 0), (2, 0.2, 1), (2, 0.2, 3), (3, None, 5)):
        metrics.append({"step": step, "valid_rmse": error, "corrections": corrections})
    metrics.append({"step": 2, "loss": 1.0})
    assert [metrics.validation(step)["corrections"] for step in (1, 2, 3)] == [0, 3, 5]
    assert metrics.validation(4) is None and metrics.best()["step"] == 2


def test_damaged_lines_give_one_warning_with_their_number(tmp_path):
    metrics = Metrics(tmp_path)
    for step in range(6):
        metrics.append({"step": step, "loss": 1.0})
    lines = metrics.path.read_text().splitlines(keepends=True)
    lines[1] = "nothing\n"
    lines[2] = lines[2].replace("1.0", "2.0")
    lines[4] = lines[4][:9] + "\n"
    metrics.path.write_text("".join(lines))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert [record["step"] for record in metrics] == [0, 3, 5]
    assert [str(one.message) for one in told] == [
        f"{metrics.path}: 3 of 6 lines are damaged and left out, the first is line 2: it is no sealed line of JSON"
    ]


def test_a_folder_in_place_of_the_file_is_one_clear_error(tmp_path):
    (tmp_path / "metrics.jsonl").mkdir()
    with pytest.raises(CheckpointError, match=r"metrics.jsonl is a folder: remove it, and with it only the curves"):
        list(Metrics(tmp_path))
