"""An object detector in the companion's own process: a network in, named detections out."""
