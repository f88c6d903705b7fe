"""The scripted ground station, and what it saw."""
