"""Forecast of the registration at a position, from the map."""
