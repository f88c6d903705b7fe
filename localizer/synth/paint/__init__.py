"""Painting: light, ground, facades, crowns."""
