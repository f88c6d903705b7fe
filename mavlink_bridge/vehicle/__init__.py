"""The vehicle's telemetry on our clock, and requests to the vehicle."""
