"""Evaluation of a run on a split: errors, times, and what the solver takes for the same frames."""

SOLVER_SCENES = 3  # in which the solver solves the deepest frame, too, unless told otherwise
