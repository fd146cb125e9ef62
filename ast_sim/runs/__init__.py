"""The files of a run folder: settings, scope, metrics, checkpoints."""

CONFIG = "config.toml"
SCOPE = "scope.toml"
