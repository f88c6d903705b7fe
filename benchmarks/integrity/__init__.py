"""How often a single registration takes a wrong place for the right one, and what that costs."""
