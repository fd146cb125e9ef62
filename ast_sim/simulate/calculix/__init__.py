"""CalculiX in place of the bundled solver."""
