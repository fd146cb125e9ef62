"""Adaptive Spatial Tokenization."""
