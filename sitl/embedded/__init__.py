"""A MAVLink 2 quadrotor simulator in one small process, for use without an ArduPilot binary.

It behaves as ArduCopter 4.7 where the companion can tell the difference: arming checks, fusion of
external positions with gates and timeouts, source sets, failsafes, routing. Attitude control is
simplified.
"""
