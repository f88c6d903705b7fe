"""Commands that prepare a flight."""
