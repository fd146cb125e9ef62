"""The files of a run folder: settings, scope, metrics, checkpoints."""
