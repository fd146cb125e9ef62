"""Meshes of bodies and how they are put together."""
