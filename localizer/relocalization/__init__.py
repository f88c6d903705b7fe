"""Relocalization without a prior: one frame against the whole map (relocalization.md)."""
