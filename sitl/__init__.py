"""Simulation in the loop: vehicles, world camera, flights and their reports."""
