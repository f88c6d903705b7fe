"""Forecast of vision along a mission, leg by leg."""
