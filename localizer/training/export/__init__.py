"""From a checkpoint to a model for the flight path, and back."""
