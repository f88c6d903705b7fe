"""The companion application: configuration, video, components, health, records, command line."""
