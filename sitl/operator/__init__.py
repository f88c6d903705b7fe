"""A simulated operator who clicks at what he sees, and what comes of his clicks."""
