"""``companion calibrate``, on the ground: finds the camera's numbers in what was filmed, and writes
them. In flight ``companion.calibration_watch`` only looks whether they hold.
"""
