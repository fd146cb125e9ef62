"""Importers: datasets and scenes from the files of other programs."""
