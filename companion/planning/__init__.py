"""Before the flight: what vision will be worth along a mission, leg by leg."""
