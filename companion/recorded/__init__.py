"""Flights as they were recorded, by whatever program: frames, telemetry and camera in one form."""
