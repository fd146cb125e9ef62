"""The two conventions of the error, against numbers worked out by hand."""

import math

import numpy as np
import pytest

from ast_sim.inference.evaluation.measures import SquaredError, rmse_pooled, rmse_sequence


def test_squared_error_counts_frames_rows_and_coordinates_of_the_chosen_rows():
    truth = np.zeros((2, 3, 2))
    prediction = np.arange(12, dtype=float).reshape(2, 3, 2)
    error = SquaredError.between(prediction, truth, np.array([True, False, True]))
    assert error.total == 0 + 1 + 16 + 25 + 36 + 49 + 100 + 121
    assert error.count == 8
    assert error.rmse == pytest.approx(math.sqrt(348 / 8))


def test_sequence_averages_roots_and_pooled_averages_squares():
    # Sequence A: 2 numbers with squared errors 4 and 4; sequence B: 6 numbers with squared errors 1.
    errors = [SquaredError(8.0, 2), SquaredError(6.0, 6)]
    assert rmse_sequence(errors) == (2.0 + 1.0) / 2
    assert rmse_pooled(errors) == math.sqrt(14 / 8)


def test_sequences_without_numbers_do_not_count():
    assert rmse_sequence([SquaredError(4.0, 1), SquaredError(0.0, 0)]) == 2.0
    assert rmse_pooled([SquaredError(4.0, 1), SquaredError(0.0, 0)]) == 2.0
    assert math.isnan(rmse_sequence([]))
    assert math.isnan(rmse_pooled([]))


def test_float32_positions_are_compared_in_float64():
    truth = np.full((1, 1, 1), 1.0, np.float32)
    prediction = np.full((1, 1, 1), np.nextafter(np.float32(1.0), np.float32(2.0)), np.float32)
    assert SquaredError.between(prediction, truth, np.array([True])).rmse == 2.0**-23
