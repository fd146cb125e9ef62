"""Sparse systems: their factorization, their solution, and what forces along some directions do."""
