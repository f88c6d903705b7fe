"""A simulated operator who clicks at a car, and what comes of it."""
