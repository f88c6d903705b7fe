"""What is told of the firmware."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionConfig
from mavlink_bridge.injection.fix_warnings import FixWarnings
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.profile import ARDUPILOT, GENERIC, FirmwareProfile


def told(message: Any, profile: FirmwareProfile) -> set[AlertId]:
    told: dict[str, Alert | None] = {}
    config = SimpleNamespace(injection=InjectionConfig(message=message))
    shared: Any = SimpleNamespace(config=config, utc=None)
    notifier: Any = SimpleNamespace(notify=told.__setitem__)
    unused: Any = None
    warnings = FixWarnings(shared, unused, notifier)
    warnings.check_firmware(VehicleState(connected=True, version=(1, 0, 0)), profile)
    return {problem.id for problem in told.values() if problem is not None}


def test_unknown_firmware_does_not_hide_that_it_does_not_take_the_message() -> None:
    both = {AlertId.UNKNOWN_FIRMWARE, AlertId.MESSAGE_UNSUPPORTED}
    assert told("odometry", GENERIC) == both
    assert told("vision_position_estimate", GENERIC) == {AlertId.UNKNOWN_FIRMWARE}
    assert told("global_position_sensor", ARDUPILOT) == {AlertId.MESSAGE_UNSUPPORTED}
    assert told("odometry", ARDUPILOT) == set()
