"""Converts vision fixes to messages for the flight controller, and checks their effect."""
