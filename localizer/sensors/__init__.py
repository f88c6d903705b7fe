"""Error models of all sensors other than the camera."""
