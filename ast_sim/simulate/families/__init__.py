"""The kinds of scenes that can be generated."""
