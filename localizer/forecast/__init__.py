"""Forecasts the registration at a pose, from the map alone."""
