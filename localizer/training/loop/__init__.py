"""The training loop, its losses and what it saves."""
