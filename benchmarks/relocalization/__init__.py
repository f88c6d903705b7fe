"""How often, how surely and at what cost one frame finds its place on a map."""
