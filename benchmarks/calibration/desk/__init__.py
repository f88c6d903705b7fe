"""Flights on a simulated clock: the vehicle, the camera and the localizer, step by step.

The vehicle's code, its MAVLink, the world camera's pictures and the localizer are those of a flight
in real time. What is not there: threads, queues and their delays, H.264 and the network.
"""
