"""In flight: whether the camera is as the deployment says, from the fixes themselves. Told, and no
number changed; ``companion.calibrate`` finds the numbers.
"""
