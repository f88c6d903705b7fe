"""Errors of the sensors other than the camera's image."""
