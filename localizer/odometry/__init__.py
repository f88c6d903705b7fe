"""Visual odometry: frame to keyframe, where the map does not match (odometry.md)."""
