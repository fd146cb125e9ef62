"""Using a trained run: predictions, evaluations, reports."""
