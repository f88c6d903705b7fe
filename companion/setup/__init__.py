"""From nothing to a deployment file: what differs from the defaults, and the full reference."""
