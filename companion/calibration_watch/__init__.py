"""Check in flight whether focal length, boresight and timestamps are as configured. It raises
alerts and changes no parameter; ``companion.calibrate`` estimates them.
"""
