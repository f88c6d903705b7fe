"""Generated worlds as 3D Tiles, their appearance, and moving objects."""
