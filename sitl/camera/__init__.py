"""The world camera: what the simulated aircraft's camera sees, as a video stream."""
