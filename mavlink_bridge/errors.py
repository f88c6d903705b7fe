"""Named errors of the bridge: each says what is wrong, where, and what to do."""

from __future__ import annotations


class BridgeError(Exception):
    """Base of every error that the bridge raises on purpose."""


class EndpointError(BridgeError):
    """A connection string that is invalid, or an endpoint that can never be opened."""


class SigningKeyError(BridgeError):
    """A MAVLink signing key file that is missing, malformed or readable by others."""


class ConnectionSilentError(BridgeError):
    """No heartbeat of an autopilot on the connection."""


class BridgeStateError(BridgeError):
    """A call that the bridge's state does not allow, such as starting it twice."""


class FixError(BridgeError):
    """A vision fix or target report whose numbers are not physical."""


class ParameterError(BridgeError):
    """A flight-controller parameter that cannot be read or written."""


class TlogError(BridgeError):
    """A .tlog file that cannot be opened, or is not one."""


class MissionError(BridgeError):
    """A mission that the flight controller does not send."""
