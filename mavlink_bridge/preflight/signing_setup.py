"""Sends the MAVLink signing key to the flight controller (SETUP_SIGNING, 256)."""

from __future__ import annotations

from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.config import BridgeConfig, SigningConfig
from mavlink_bridge.errors import BridgeStateError, ConnectionSilentError
from mavlink_bridge.link.signing import load_key, signing_timestamp
from mavlink_bridge.preflight.client import VehicleClient

_REPEATS = 3
_APART_S = 0.3


def _send(client: VehicleClient, key: bytes) -> None:
    """Send the key and the time a few times, because nothing acknowledges them."""
    message = mavlink.MAVLink_setup_signing_message(
        client.system, client.component, list(key), signing_timestamp()
    )
    for _ in range(_REPEATS):
        client.ask(message)
        client.wait_for(lambda: False, _APART_S)


def install_key(connection: str, key_file: Path) -> bool:
    """Send the key of a file to the autopilot; True if its heartbeat is then signed with it.

    False on ArduPilot's USB port, which stays unsigned, and if the autopilot already used another
    key. Raises `BridgeStateError` if the vehicle is armed, because ArduPilot then ignores the key;
    `ConnectionSilentError` without a vehicle, `SigningKeyError` for an unusable key file.
    """
    key = load_key(key_file)
    config = BridgeConfig(connection=connection)
    with VehicleClient(config, "signing", ()) as client:
        if client.armed:
            raise BridgeStateError(f"{connection}: the vehicle is armed; disarm it, then install")
        _send(client, key)
    signed = config.model_copy(update={"signing": SigningConfig(key_file=key_file)})
    try:
        with VehicleClient(signed, "signing", ()):
            return True
    except ConnectionSilentError:
        return False
