"""Flights with the whole companion in the loop: world camera, video, engine, bridge, autopilot.

A file in ``sitl/scenarios/loop`` says what goes wrong when, and what must come of it. The other
scenarios of the suite feed the bridge with positions made of the truth; these feed it nothing.
"""
