"""In flight: checks by the fixes themselves whether the camera is as the deployment says. It raises
alerts and changes no number; ``companion.calibrate`` estimates the numbers.
"""
