"""The lines of `metrics.jsonl`: which of several validations counts."""

from ast_sim.runs.metrics import Metrics


def test_the_last_validation_of_a_step_counts(tmp_path):
    metrics = Metrics(tmp_path)
    for step, error, corrections in ((1, 0.3, 0), (2, 0.2, 1), (2, 0.2, 3), (3, None, 5)):
        metrics.append({"step": step, "valid_rmse": error, "corrections": corrections})
    metrics.append({"step": 2, "loss": 1.0})
    assert [metrics.validation(step)["corrections"] for step in (1, 2, 3)] == [0, 3, 5]
    assert metrics.validation(4) is None and metrics.best()["step"] == 2
