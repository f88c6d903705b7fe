"""Training places: land, objects, what changes between two visits."""
