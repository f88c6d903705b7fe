"""From a painted scene to 3D Tiles."""
