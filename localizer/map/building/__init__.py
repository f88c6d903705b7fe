"""Converts a map source to a tile cache: levels of detail, worker pools, atomic publishing."""
