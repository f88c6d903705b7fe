"""Acceptance and confirmation of estimates, and their error bounds."""
