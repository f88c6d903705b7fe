"""Makes deployment files, and the reference of all settings."""
