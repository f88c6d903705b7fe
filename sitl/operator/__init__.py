"""A simulated operator who clicks a car to track, and the evaluation of the track."""
