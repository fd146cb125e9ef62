"""What a callback of `train` is told, how it ends a training, and the files for TensorBoard."""

import sys

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import ast_sim
from ast_sim.runs import checkpoint
from ast_sim.runs.folder import RunFolder

SMALL = {
    "steps": 6,
    "batch_size": 1,
    "log_every": 2,
    "validate_every": 3,
    "checkpoint_every": 6,
    "warmup": 1,
    "validate_scenes": 1,
}


def train(data, out, callback, **more):
    hidden = {"hidden": 8, "blocks": 1}
    return ast_sim.train(data, out, model="mgn", model_settings=hidden, callback=callback, **{**SMALL, **more})


def records(folder):
    return [record for record in RunFolder(folder).metrics if "step" in record]


def test_tensorboard_has_the_figures_of_the_metrics(data, tmp_path):
    told = []
    board = ast_sim.TensorBoard(tmp_path / "board")

    def both(step, figures):
        told.append((step, figures))
        board(step, figures)

    train(data, tmp_path / "run", both)
    assert [step for step, _ in told] == [2, 3, 4, 6, 6]
    written = records(tmp_path / "run")
    assert [figures["loss"] for _, figures in told if "loss" in figures] == [r["loss"] for r in written if "loss" in r]
    events = EventAccumulator(str(tmp_path / "board")).Reload()
    for name in ("loss", "valid_rmse"):
        expected = [(r["step"], pytest.approx(r[name], rel=1e-6)) for r in written if name in r]
        assert len(expected) in (2, 3)
        assert [(event.step, event.value) for event in events.Scalars(name)] == expected


@pytest.mark.parametrize("at, key", [(4, "loss"), (3, "valid_rmse")])
def test_an_error_ends_the_training_after_a_checkpoint(data, tmp_path, at, key):
    def stop(step, figures):
        if step == at and key in figures:
            raise ZeroDivisionError("enough")

    with pytest.raises(ZeroDivisionError, match="enough"):
        train(data, tmp_path / "run", stop)
    assert str(at) in checkpoint.latest(tmp_path / "run").name  # the step
    told = []
    train(data, tmp_path / "run", lambda step, figures: told.append(step), resume=True)
    assert told[-1] == 6 and min(told) > at


def test_tensorboard_that_is_missing_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(ast_sim.AstSimError, match=r'pip install "ast_sim\[tensorboard\]"'):
        ast_sim.TensorBoard(tmp_path)
