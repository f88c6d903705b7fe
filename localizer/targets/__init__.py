"""Coordinates of pixels, and targets over time."""
