"""``companion calibrate``: estimates camera and mounting from recorded images on the ground, and
writes them. In flight ``companion.calibration_watch`` only checks them.
"""
