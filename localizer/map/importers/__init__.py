"""Map importers: each reader converts its source to meshes with ECEF positions."""
