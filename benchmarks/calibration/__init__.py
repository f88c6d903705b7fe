"""Calibration from drawn errors, measured."""
