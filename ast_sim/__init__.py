"""Learned simulation of deforming bodies in contact by Adaptive Spatial Tokenization."""

__version__ = "0.1.0"
