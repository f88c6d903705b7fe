"""Looking at a tile cache: figures, integrity, pictures."""
