"""``companion key``: a key is made once, and given to a disarmed vehicle only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

from companion.cli.commands import app
from companion.errors import ConfigError
from mavlink_bridge.errors import BridgeStateError
from mavlink_bridge.link.signing import load_key
from tests.mavlink_bridge.conftest import FakeAutopilot


class Vehicle(FakeAutopilot):
    """Takes SETUP_SIGNING as ArduPilot does, and signs from then on."""

    armed = False

    def send(self, message: Any, component: int = 1, system: int = 1) -> None:
        if self.armed and message.get_type() == "HEARTBEAT":
            message.base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        super().send(message, component, system)

    def answer(self, m: Any) -> None:
        if m.get_type() != "SETUP_SIGNING":
            super().answer(m)
            return
        signing = self.codec.signing
        if signing.secret_key is None:
            signing.secret_key, signing.sign_outgoing = bytes(m.secret_key), True
            signing.timestamp = m.initial_timestamp


def test_a_key_is_made_for_its_owner_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.key"
    result = CliRunner().invoke(app, ["key", str(path)])
    assert result.exit_code == 0, result.output
    key = load_key(path)
    assert path.stat().st_mode & 0o777 == 0o600
    again = CliRunner().invoke(app, ["key", str(path)])
    assert isinstance(again.exception, ConfigError)
    assert load_key(path) == key
    assert key.hex() not in result.output


def test_a_connection_that_is_none_is_told_before_a_key_is_made(tmp_path: Path) -> None:
    path = tmp_path / "mavlink.key"
    result = CliRunner().invoke(app, ["key", str(path), "--install", "pigeon:1"])
    assert isinstance(result.exception, ConfigError)
    assert "--install pigeon:1" in str(result.exception)
    assert not path.exists()


def test_the_vehicle_signs_with_the_installed_key(tmp_path: Path) -> None:
    path, vehicle = tmp_path / "mavlink.key", Vehicle()
    try:
        where = f"udpout:127.0.0.1:{vehicle.port}"
        result = CliRunner().invoke(app, ["key", str(path), "--install", where])
        assert result.exit_code == 0, result.output
        assert "heartbeat is signed" in result.output
        assert vehicle.codec.signing.secret_key == load_key(path)
    finally:
        vehicle.stop()


def test_an_armed_vehicle_is_given_no_key(tmp_path: Path) -> None:
    path, vehicle = tmp_path / "mavlink.key", Vehicle()
    vehicle.armed = True
    try:
        where = f"udpout:127.0.0.1:{vehicle.port}"
        result = CliRunner().invoke(app, ["key", str(path), "--install", where])
        assert isinstance(result.exception, BridgeStateError)
        assert "disarm" in str(result.exception)
        assert not vehicle.of("SETUP_SIGNING")
    finally:
        vehicle.stop()
