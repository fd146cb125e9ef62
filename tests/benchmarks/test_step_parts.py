"""The part of a step that no scene causes."""

import pytest

from benchmarks.steps import before_after, newton, newton_worker, parts, predictions
from benchmarks.steps.step_worker import nodes


def test_the_fixed_part_is_where_the_line_through_the_times_meets_no_scene():
    assert parts.fixed_part({1: 12.0, 4: 18.0, 8: 26.0}) == pytest.approx((10.0, 2.0))
    assert parts.fixed_part({1: 13.0, 4: 18.0, 8: 27.0})[0] == pytest.approx(10.61, abs=0.01)  # least squares


def test_only_nodes_of_autograd_are_counted():
    counted = {"autograd::engine::evaluate_function: ViewBackward0": 3, "ViewBackward0": 3, "aten::view": 5}
    assert nodes(counted) == {"ViewBackward0": 3}


def test_a_ratio_is_of_neighbours():
    told = before_after.summary({"before": [2.0, 9.0, 4.0], "now": [1.0, 3.0, 4.0]})
    assert told == {"min_ms": {"before": 2e3, "now": 1e3}, "median_ms": {"before": 4e3, "now": 3e3}, "ratio": 2.0}


def test_times_of_predictions_and_the_roundings_between_them():
    before = {"clock": [4.0, 2.0, 9.0], "processor": [3.0, 1.0, 8.0], "position": [1.0, -2.0]}
    now = {"clock": [1.0, 3.0, 2.0], "processor": [1.0, 3.0, 0.5], "position": [1.0, -2.0 + 2**-22]}
    assert predictions.line_of({"before": before, "now": now}) == (
        "clock: before 2.00 (4.00), now 1.00 (2.00) ms; processor: before 1.00 (3.00), now 0.50 (1.00) ms;"
        " positions differ by 2 roundings"
    )


def test_newton_steps_are_told_by_least_and_median():
    told = [{"setup": [2.0, 1.0], "steps": [[5.0, 3.0], [4.0, 6.0]]}, {"setup": [3.0], "steps": [[9.0, 9.0]]}]
    times = newton.summary(told)
    assert times == {"least": [1.0, 4.0, 3.0], "median": [2.0, 5.0, 6.0]}
    row = {"before": None, "now": times, "difference": 1e-12}
    assert newton.line_of("a plate", row, 60) == (
        "| a plate | not within 60 s | 1e+03 (2e+03), 4e+03 (5e+03), 3e+03 (6e+03) | 1e-12 |"
    )
    assert newton.summary([]) is None


def test_the_scenes_of_newton_steps_have_the_sizes_of_their_names():
    for name, cells in newton.CASES.items():
        if cells[2] <= 8 and cells[0] < 100:
            make = newton_worker.plate if name.startswith("plate") else newton_worker.two_blocks
            scene, position, _ = make(cells)
            assert f" {scene.num_nodes:,} nodes" in name
            assert position.shape == scene.rest_position.shape
