"""The flight process: its components and their connections."""
