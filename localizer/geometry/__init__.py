"""Poses, cameras, geodesy of the map's frame, and PiLoT's pose files."""
