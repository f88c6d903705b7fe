"""What is made of the alert catalogue (`mavlink_bridge.alerts`): its reference page."""
