"""Milliseconds per LM iteration and per registration."""
