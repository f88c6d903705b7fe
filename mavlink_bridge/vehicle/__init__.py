"""What the vehicle says, on our clock, and what it is asked for."""
