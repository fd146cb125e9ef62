"""The contact solver."""
