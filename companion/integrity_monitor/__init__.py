"""The monitor: an independent monitor with its own evidence and the last word before injection."""
