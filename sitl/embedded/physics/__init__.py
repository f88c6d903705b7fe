"""Rigid body, sensors and gimbal of the simulated vehicle."""
