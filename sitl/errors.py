"""Named errors of the simulation: each says what is wrong, where, and what to do."""

from __future__ import annotations


class SimulationError(Exception):
    """Base of every error that the simulation raises on purpose."""


class WorldCameraError(SimulationError):
    """A world camera that could not start, or whose process died."""


class FlightError(SimulationError):
    """A flight that was aborted; names the part that failed and its log."""


class PilotError(SimulationError):
    """The vehicle refused, or did not do in time, what the pilot asked."""


class VehicleError(Exception):
    """Base of every error that the embedded vehicle raises on purpose."""


class ParameterFileError(VehicleError):
    """A parameter file that cannot be read; names file and line."""


class PortError(VehicleError):
    """A TCP port that cannot be listened on."""
