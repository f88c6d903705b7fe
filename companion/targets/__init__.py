"""An operator's clicks and a detector's pixels become target coordinates."""
