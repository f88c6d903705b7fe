"""Checks before the flight: parameters, mission, link, clock."""
