"""After the flight: replay and pictures."""
