"""Recorded flights of any program in one form: frames, telemetry and camera."""
