"""Records for other programs: MCAP with Foxglove's schemas."""
