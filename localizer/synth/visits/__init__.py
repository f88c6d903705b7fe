"""Differences between a place as surveyed and as flown over later."""
