"""Locates targets: pixels of operator clicks and detectors become coordinates."""
