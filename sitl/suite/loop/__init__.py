"""Flights with the complete companion in the loop: world camera, video, engine, bridge, autopilot.

A file in ``sitl/scenarios/loop`` gives the faults in time and the expectations. The other scenarios
of the suite use fixes made from the truth; these use rendered video.
"""
