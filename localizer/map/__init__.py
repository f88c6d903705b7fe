"""The map: importers, the tile cache on disk, streaming, picking."""
