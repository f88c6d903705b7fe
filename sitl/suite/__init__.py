"""Scenario suite: flies the bridge with simulated fixes and checks measured behaviour of ArduPilot.

A scenario file (`sitl/scenarios/NAME.yaml`) gives the fixes, the faults in time, and the
expectations. `python -m sitl suite` flies all of them on either vehicle and prints a table.
"""
