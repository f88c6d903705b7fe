"""Supervises the flight process: reports its death and restarts it."""
