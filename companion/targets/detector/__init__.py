"""An object detector in the companion's process: network, and detections with names."""
