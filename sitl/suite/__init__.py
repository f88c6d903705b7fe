"""The scenario suite: what ArduPilot was measured to do, flown again with our bridge and judged.

A scenario file (`sitl/scenarios/NAME.yaml`) says what is fed, what goes wrong when, and what must
come of it; `python -m sitl suite` flies all of them on either vehicle and prints one table.
"""
