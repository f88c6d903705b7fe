"""Simulated vehicles as processes: ArduPilot SITL, or the embedded one."""
