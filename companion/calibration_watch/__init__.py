"""Whether the camera is as the deployment says: watched in flight, from the fixes themselves."""
