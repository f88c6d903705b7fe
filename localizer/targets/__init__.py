"""Locates pixels on the map, and tracks targets."""
