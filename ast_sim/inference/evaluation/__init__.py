"""Evaluation of a run on a split: errors, times, and what the solver takes for the same frames."""
