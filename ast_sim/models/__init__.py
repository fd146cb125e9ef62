"""The models, and the code that they share."""
