"""An independent client (MAVSDK) on the autopilot's other port: what ArduPilot routes, both ways.

The same test runs against the embedded vehicle and the real ArduCopter.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.camera import Camera
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, CameraView, TargetReport, TrackRequest, VisionFix
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.reading import values_of
from mavlink_bridge.alerts.words import InjectionOrder
from mavlink_bridge.config import CameraConfig, InjectionConfig, OriginConfig, TargetsConfig
from mavlink_bridge.link.link import sleep_until
from sitl.geodesy import Location
from sitl.vehicles.launch import GIMBAL, ArduPilotSitl, EmbeddedSitl, vision_only_parameters

PROMISED = (
    "CAMERA_TRACKING_GEO_STATUS",
    "CAMERA_FOV_STATUS",
    "CAMERA_IMAGE_CAPTURED",
    "NAMED_VALUE_FLOAT",
)
HOME = Location(47.397742, 8.545594, 488.0)
GEOID = 47.3


@pytest.fixture(params=[EmbeddedSitl, pytest.param(ArduPilotSitl, marks=pytest.mark.sitl)])
def vehicle(request: pytest.FixtureRequest) -> Iterator[Any]:
    with request.param(HOME, parameters=GIMBAL | vision_only_parameters()) as process:
        yield process


class Station:
    """A ground station made of MAVSDK: what it heard, by message."""

    def __init__(self, sdk: Any) -> None:
        self.system = sdk.first_autopilot(30.0)
        assert self.system is not None
        self.direct = MavlinkDirect(self.system)
        self.heard: dict[str, list[dict[str, Any]]] = {}

    def listen(self, name: str) -> None:
        self.heard[name] = []
        self.direct.subscribe_message(
            name, lambda message, _: self.heard[name].append(json.loads(message.fields_json))
        )

    def command(self, command: int, component: int, *parameters: float) -> int:
        """MAV_RESULT of a COMMAND_LONG to a component; -1 if nobody answers."""
        padded = [*parameters, *([0.0] * (7 - len(parameters)))]
        fields = {"target_system": 1, "target_component": component, "command": command}
        fields |= {"confirmation": 0} | {f"param{i}": p for i, p in enumerate(padded, 1)}
        before = len(self.heard["COMMAND_ACK"])
        self.direct.send_message(
            MavlinkMessage("COMMAND_LONG", 245, 190, 1, component, json.dumps(fields))
        )

        def answers() -> list[dict[str, Any]]:
            return [m for m in self.heard["COMMAND_ACK"][before:] if m["command"] == command]

        sleep_until(lambda: bool(answers()), 30.0)
        return int(answers()[-1]["result"]) if answers() else -1


def test_an_independent_client_through_the_autopilots_routing(vehicle: Any, tmp_path: Path) -> None:
    asked: list[TrackRequest] = []
    path = tmp_path / "flight.tlog"
    config = BridgeConfig(
        connection=vehicle.companion_endpoint,
        mode="rc",
        tlog=path,
        ground_systems=(245,),
        named_values=True,
        targets=TargetsConfig(captured=True),
        camera=CameraConfig(stream_uri="rtsp://10.0.0.2:8554/main"),
    )
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    with Bridge(config, GEOID, on_track=asked.append) as bridge:
        try:
            converse(vehicle, bridge, sdk, asked)
        finally:
            sdk.destroy()
    kinds: dict[str, int] = {}
    log = mavutil.mavlink_connection(str(path))
    while (m := log.recv_match()) is not None:
        kinds[m.get_type()] = kinds.get(m.get_type(), 0) + 1
    log.close()
    assert kinds.pop("BAD_DATA", 0) == 0
    assert kinds["CAMERA_TRACKING_GEO_STATUS"] > 0
    assert kinds["ATTITUDE"] > 10
    assert {"COMMAND_LONG", "COMMAND_ACK", "CAMERA_FOV_STATUS", "TIMESYNC"} <= set(kinds)


def converse(vehicle: Any, bridge: Bridge, sdk: Any, asked: list[TrackRequest]) -> None:
    assert sleep_until(lambda: bridge.state().connected, 30.0)
    sdk.add_any_connection(vehicle.spare_endpoint.replace("tcp:", "tcpout://"))
    station = Station(sdk)
    camera = Camera(station.system)
    for name in (*PROMISED, "COMMAND_ACK", "STATUSTEXT", "VIDEO_STREAM_INFORMATION"):
        station.listen(name)

    def report() -> bool:
        now = time.monotonic_ns()
        bridge.report(TargetReport(now, 47.398, 8.546, 535.3, h_accuracy_m=2.0))
        bridge.report_view(
            CameraView(now, 47.3975, 8.5455, 635.3, (0.8, 0.0, -0.6, 0.0), 47.399, 8.547)
        )
        bridge.send_named_values({"VPS_SIGNAL": 2.0})
        return bool(all(station.heard[k] for k in PROMISED) and camera.camera_list().cameras)

    assert sleep_until(report, 30.0, step_s=0.2), station.heard
    geo = station.heard["CAMERA_TRACKING_GEO_STATUS"][-1]
    assert (geo["lat"], geo["lon"], geo["h_acc"]) == (473980000, 85460000, 2.0)
    assert geo["alt"] == pytest.approx(535.3 - GEOID, abs=0.01)
    view = station.heard["CAMERA_FOV_STATUS"][-1]
    assert (view["lat_camera"], view["lon_camera"]) == (473975000, 85455000)
    assert view["alt_camera"] == pytest.approx(588_000, abs=2)
    assert (view["lat_image"], view["lon_image"]) == (473990000, 85470000)
    assert view["q"] == pytest.approx([0.8, 0.0, -0.6, 0.0])
    mark = station.heard["CAMERA_IMAGE_CAPTURED"]
    assert {(m["lat"], m["lon"], m["alt"]) for m in mark} == {(473980000, 85460000, 488_000)}
    figure = station.heard["NAMED_VALUE_FLOAT"][-1]
    assert (figure["name"].rstrip("\0"), figure["value"]) == ("VPS_SIGNAL", 2.0)
    station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 100, 269.0)
    assert sleep_until(lambda: bool(station.heard["VIDEO_STREAM_INFORMATION"]), 30.0)
    stream = station.heard["VIDEO_STREAM_INFORMATION"][-1]
    assert stream["uri"].rstrip("\0") == "rtsp://10.0.0.2:8554/main"
    (information,) = camera.camera_list().cameras
    assert (information.component_id, information.model_name) == (100, "map camera")
    camera.track_point(100, 0.25, 0.75, 0.1)
    assert sleep_until(lambda: len(asked) == 1, 30.0)
    assert asked[0].coordinates == pytest.approx((0.25, 0.75))

    # The gate of mode rc, by a command to the localizer's component.
    assert not bridge.injecting
    assert station.command(mavlink.MAV_CMD_USER_1, 197, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    assert bridge.injecting
    assert station.command(mavlink.MAV_CMD_USER_1, 197, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    assert not bridge.injecting
    assert station.command(mavlink.MAV_CMD_USER_2, 197, 1.0) == mavlink.MAV_RESULT_UNSUPPORTED

    def alerts() -> list[Any]:
        switched = (AlertId.INJECTION_ON, AlertId.INJECTION_OFF)
        read = [values_of(m["text"]) for m in station.heard["STATUSTEXT"]]
        return [one for one in read if one is not None and one[0] in switched]

    assert sleep_until(lambda: len(alerts()) == 2, 30.0), station.heard["STATUSTEXT"]
    by = {"by": InjectionOrder.COMMAND.value}
    assert alerts() == [(AlertId.INJECTION_ON, by), (AlertId.INJECTION_OFF, by)]

    def gimbal() -> Any:
        return bridge.gimbal_at(time.monotonic_ns() - 200_000_000)

    assert sleep_until(lambda: gimbal() is not None, 30.0)
    assert gimbal().source == "GIMBAL_DEVICE_ATTITUDE_STATUS"


def test_the_autopilots_vision_bit_is_healthy_while_positions_come(vehicle: Any) -> None:
    """SYS_STATUS, which QGroundControl lists by name."""
    config = BridgeConfig(
        connection=vehicle.companion_endpoint,
        mode="inject",
        injection=InjectionConfig(force=True),
        origin=OriginConfig(latitude_deg=47.397742, longitude_deg=8.545594, altitude_amsl_m=488.0),
    )
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    with Bridge(config, GEOID) as bridge:
        try:
            sdk.add_any_connection(vehicle.spare_endpoint.replace("tcp:", "tcpout://"))
            station = Station(sdk)
            for name in ("COMMAND_ACK", "SYS_STATUS"):
                station.listen(name)
            station.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 1, 1.0, 100_000.0)

            def bits() -> tuple[bool, ...]:
                newest = station.heard["SYS_STATUS"][-1] if station.heard["SYS_STATUS"] else {}
                kinds = ("present", "enabled", "health")
                masks = (int(newest.get(f"onboard_control_sensors_{k}", 0)) for k in kinds)
                return tuple(bool(m & mavlink.MAV_SYS_STATUS_SENSOR_VISION_POSITION) for m in masks)

            def fed() -> bool:
                place = (47.397742, 8.545594, 488.0 + GEOID)
                exposed_ns, sigma = time.monotonic_ns() - 50_000_000, np.eye(3) * 0.25
                bridge.submit(VisionFix(exposed_ns, *place, position_covariance_ned=sigma))
                return bits() == (True, True, True)

            assert sleep_until(lambda: bits() == (True, True, False), 60.0), station.heard
            assert sleep_until(fed, 60.0, step_s=0.05), (bits(), bridge.alerts())
            assert sleep_until(lambda: bits() == (True, True, False), 60.0), station.heard
        finally:
            sdk.destroy()
