"""Recorded sequences and the paper's error measures."""
