"""Poses, cameras, the geodesy of a map's frame, and PiLoT's pose lines."""
