"""Convert vision fixes to messages for the flight controller, and check their effect."""
