"""Named errors of the embedded vehicle."""

from __future__ import annotations


class VehicleError(Exception):
    """Base of every error that the embedded vehicle raises on purpose."""


class ParameterFileError(VehicleError):
    """A parameter file that cannot be read; names file and line."""


class PortError(VehicleError):
    """A TCP port that cannot be listened on."""
