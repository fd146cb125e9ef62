"""Exodus files: what they say of themselves before VTK reads them, their groups, and pieces of parallel runs."""

EXODUS = (".e", ".ex2", ".exo", ".exoii", ".exii", ".g", ".gen")
