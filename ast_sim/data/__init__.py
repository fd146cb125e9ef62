"""Scenes, trajectories, dataset files, graphs and the pairs that a model is trained on."""
