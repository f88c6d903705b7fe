"""Inspection of a tile cache: figures, integrity, images."""
