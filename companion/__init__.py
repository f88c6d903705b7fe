"""The companion process: configuration, camera feeds, wiring, health, recording, CLI."""
