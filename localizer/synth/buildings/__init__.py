"""Buildings: footprints, kinds and the surfaces of each."""
