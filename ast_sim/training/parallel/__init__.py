"""Training a model: settings that follow from the data, the loop, optimizers, validation, checkpoints."""
