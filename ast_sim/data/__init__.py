"""Scenes, trajectories, the dataset file and its sampling; `scene`, `file` and `convert` need no torch."""
