"""Control loops, modes, missions, arming."""
