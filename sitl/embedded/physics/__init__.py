"""The rigid body, its sensors and its gimbal."""
