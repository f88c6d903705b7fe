"""What the flight shows to the console, over a local socket; and what the console may ask."""
