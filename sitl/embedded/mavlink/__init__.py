"""The vehicle's MAVLink: server, commands, telemetry."""
