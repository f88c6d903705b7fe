"""Map importers: each converts its source to meshes with ECEF positions."""
