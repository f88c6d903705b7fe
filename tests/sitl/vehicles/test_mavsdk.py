"""An independent MAVLink client (MAVSDK) takes the embedded vehicle for what it says it is."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.mission_raw import MissionItem, MissionRaw
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import FlightMode, Telemetry

from sitl.geodesy import Location
from sitl.vehicles.launch import EmbeddedSitl, vision_only_parameters

HOME = Location(47.397742, 8.545594, 488.0)
T = TypeVar("T")


@contextmanager
def seen_by_mavsdk(vehicle: EmbeddedSitl) -> Iterator[Any]:
    with vehicle:
        sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
        sdk.add_any_connection(vehicle.gcs_endpoint.replace("tcp:", "tcpout://"))
        try:
            yield sdk.first_autopilot(60.0)
        finally:
            sdk.destroy()


@pytest.fixture
def system():
    with seen_by_mavsdk(EmbeddedSitl(HOME, 40.0, vision_only_parameters())) as found:
        yield found


def answer(ask: Callable[[], T]) -> T:
    """What MAVSDK was told: it gives up after a second, which a busy machine may take."""
    deadline = time.monotonic() + 120.0
    while True:
        try:
            return ask()
        except MavsdkError as error:
            late = {"TIMEOUT", "INFORMATION_NOT_RECEIVED_YET"}
            if error.result.name not in late or time.monotonic() > deadline:
                raise
            time.sleep(0.1)


def test_mavsdk_reads_version_parameters_missions_and_telemetry(system):
    assert system.get_system_id() == 1

    version = answer(Info(system).get_version)
    assert (version.flight_sw_major, version.flight_sw_minor) == (4, 7)
    parameters = Param(system)
    assert answer(lambda: parameters.get_param_float("WPNAV_SPEED")) == 1000.0

    missions = MissionRaw(system)
    places = [(16, 0), (22, 0), (16, 5000), (21, 0)]
    items = [
        MissionItem(
            seq, 3, command, int(seq == 0), 1, 0, 0, 0, 0, 473977420 + dx, 85455940, 30.0, 0
        )
        for seq, (command, dx) in enumerate(places)
    ]
    answer(lambda: missions.upload_mission(items))
    back = answer(missions.download_mission)
    assert [(i.command, i.x) for i in back] == [(i.command, i.x) for i in items]

    telemetry = Telemetry(system)
    answer(lambda: telemetry.set_rate_attitude_euler(10.0))
    deadline = time.monotonic() + 60.0
    while math.isnan(telemetry.attitude_euler().yaw_deg) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert telemetry.attitude_euler().yaw_deg == pytest.approx(40.0, abs=5.0)
    assert not telemetry.armed()


def test_mavsdk_takes_the_px4_interface_for_px4():
    """Its modes by PX4's numbers, and integers that travel as bytes; it arms on GNSS in Hold."""
    with seen_by_mavsdk(EmbeddedSitl(HOME, speedup=10.0, px4=True)) as system:
        version = answer(Info(system).get_version)
        assert (version.flight_sw_major, version.flight_sw_minor) == (1, 17)
        parameters = Param(system)
        answer(lambda: parameters.set_param_int("EKF2_AGP0_CTRL", 1))
        assert answer(lambda: parameters.get_param_int("EKF2_AGP0_CTRL")) == 1
        assert answer(lambda: parameters.get_param_float("EKF2_AGP0_GATE")) == 3.0
        action, telemetry = Action(system), Telemetry(system)
        answer(action.hold)
        deadline = time.monotonic() + 60.0
        while not telemetry.armed() and time.monotonic() < deadline:
            with suppress(MavsdkError):
                action.arm()
            time.sleep(0.2)
        assert telemetry.armed()
        assert telemetry.flight_mode() == FlightMode.HOLD
