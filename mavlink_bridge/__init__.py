"""Everything that speaks MAVLink, and nothing that sees images."""
