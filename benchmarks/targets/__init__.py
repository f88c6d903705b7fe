"""Targets: places and velocities against the truth, at edges, on plain ground, and of cars."""
