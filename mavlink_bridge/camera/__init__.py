"""The camera component: MAVLink camera protocol, targets, Cursor-on-Target."""
