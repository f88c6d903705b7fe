"""The integrity monitor: checks every fix with independent evidence before it is injected."""
