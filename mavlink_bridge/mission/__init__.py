"""Interprets mission items: flown positions and camera direction."""
