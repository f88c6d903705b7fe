"""A MAVLink 2 quadrotor in one small process, for when no ArduPilot binary is at hand.

It answers as ArduCopter 4.7 does where the companion can tell the difference: arming refusals,
fusion of injected positions with gates and timeouts, source sets, failsafes, routing. It is no
flight controller: attitude control knows the airframe it flies.
"""
