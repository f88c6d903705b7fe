"""The tile cache on disk, tiles in memory, selection, streaming and picking. Renders nothing."""
