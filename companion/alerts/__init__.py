"""The reference page of the alert catalogue (`mavlink_bridge.alerts`)."""
