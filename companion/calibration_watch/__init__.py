"""Checks in flight whether focal length, boresight and timestamps are as configured.

Alerts only: no parameter changes; ``companion.calibrate`` estimates them.
"""
