"""What the bridge can carry."""
