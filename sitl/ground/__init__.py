"""The scripted ground station and its records."""
