"""The vehicle's telemetry with times on CLOCK_MONOTONIC, and requests to the vehicle."""
