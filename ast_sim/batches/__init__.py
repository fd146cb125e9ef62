"""From scenes to the batches that a model gets."""
