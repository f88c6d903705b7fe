"""Terminal output of a command: log, steps, progress."""
