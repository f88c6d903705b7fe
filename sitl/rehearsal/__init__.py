"""Fly a planned mission in simulation over the user's own map."""
