"""Recorded sequences and the paper's measures."""
