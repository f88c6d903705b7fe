"""``companion calibrate``: a deployment's camera, mounting and times from what was filmed."""
