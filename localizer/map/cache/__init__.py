"""The tile cache: files, tiles in memory, selection, streaming and picking. No rendering."""
