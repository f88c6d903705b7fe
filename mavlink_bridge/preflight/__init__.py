"""Before the flight: parameters, mission, the examination."""
