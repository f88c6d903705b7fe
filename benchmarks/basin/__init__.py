"""Convergence of the registration."""
