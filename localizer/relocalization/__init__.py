"""Where am I, without a prior: one frame against the whole map (relocalization.md)."""
