"""Pixels to places on Earth, and a target over time."""
