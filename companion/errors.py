"""Named errors of the companion process."""

from __future__ import annotations


class CompanionError(Exception):
    """Base of every error that the companion process raises on purpose."""


class ConfigError(CompanionError):
    """A configuration that cannot be read or does not hold; names file and key."""


class DetectionError(CompanionError):
    """A datagram that is not a pixel detection."""
