"""What a map may be made from: each reader turns its source into meshes with ECEF positions."""
