"""A planned mission, flown in simulation over the user's own map."""
