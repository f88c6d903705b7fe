"""The whole bridge against a small autopilot over UDP loopback."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, HealthLevel, TargetReport, VisionFix
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import RcChannel
from mavlink_bridge.config import InjectionConfig, SigningConfig, TargetsConfig
from mavlink_bridge.errors import BridgeStateError
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.link.signing import create_key
from mavlink_bridge.messages import PlaceHint
from tests.mavlink_bridge.simulated import GEOID, HOME, ORIGIN

LISTENING = "udpin:127.0.0.1:0"


def config(port: int, **options: Any) -> BridgeConfig:
    options.setdefault("origin", ORIGIN)
    options.setdefault("mode", "inject")
    options.setdefault("injection", InjectionConfig(rate_hz=20, delay_ms=30))
    return BridgeConfig(connection=f"udpout:127.0.0.1:{port}", **options)


@pytest.fixture
def run() -> Iterator[Callable[..., Bridge]]:
    """Starts bridges and waits until they have found the autopilot.

    One that listens on port 0 is where the autopilot sends to.
    """
    made: list[Bridge] = []

    def start(settings: BridgeConfig, autopilot: Any, **options: Any) -> Bridge:
        bridge = Bridge(settings, GEOID, **options)
        made.append(bridge)
        bridge.start()
        if settings.connection == LISTENING:
            assert sleep_until(lambda: bridge.port is not None, 30.0)
            autopilot.peer = ("127.0.0.1", bridge.port)
        assert sleep_until(lambda: bridge.state().connected, 30.0)
        return bridge

    yield start
    for bridge in made:
        bridge.stop()


def feed(bridge: Bridge, until: Callable[[], bool]) -> None:
    """Fixes at 20 Hz until something has come of them."""

    def fed() -> bool:
        fix = VisionFix(
            time.monotonic_ns() - 20_000_000,
            *HOME,
            488.0 + GEOID + 60.0,
            (1.0, 0.0, 0.0, 0.0),
            np.eye(3) * 0.25,
        )
        bridge.submit(fix)
        return until()

    assert sleep_until(fed, 30.0, step_s=0.05), bridge.counters()


def more(autopilot: Any, count: int) -> Callable[[], bool]:
    """Whether so many more positions have come."""
    wanted = len(autopilot.of("VISION_POSITION_ESTIMATE")) + count
    return lambda: len(autopilot.of("VISION_POSITION_ESTIMATE")) >= wanted


def test_identity_origin_and_injection(autopilot: Any, run: Callable[..., Bridge]) -> None:
    bridge = run(config(autopilot.port), autopilot)
    assert sleep_until(lambda: bridge.state().origin is not None, 30.0)
    assert sleep_until(lambda: bridge.state().clock_source == "timesync", 30.0)
    assert sleep_until(lambda: bridge.state().version == (4, 7, 0), 30.0)
    feed(bridge, more(autopilot, 10))
    vision = autopilot.of("VISION_POSITION_ESTIMATE")
    assert {m.get_srcSystem() for m in vision} == {1}
    assert {m.get_srcComponent() for m in vision} == {197}
    assert (vision[-1].x, vision[-1].y, vision[-1].z) == pytest.approx((0, 0, -60), abs=0.02)
    # One tick sends all three.
    assert sleep_until(lambda: len(autopilot.of("HEARTBEAT")) >= 3, 30.0)
    heartbeats = autopilot.of("HEARTBEAT")
    assert {m.get_srcComponent() for m in heartbeats} == {197, 191, 100}
    assert {m.type for m in heartbeats if m.get_srcComponent() == 100} == {mavlink.MAV_TYPE_CAMERA}
    assert all(m.autopilot == mavlink.MAV_AUTOPILOT_INVALID for m in heartbeats)
    assert len(autopilot.of("SET_GPS_GLOBAL_ORIGIN")) == 1
    assert bridge.state().profile == "ArduPilot 4.5-4.7"
    # Exposure on our own clock.
    assert abs(vision[-1].usec * 1000 - time.monotonic_ns()) < 10e9


def test_rc_channel_gates_injection(autopilot: Any, run: Callable[..., Bridge]) -> None:
    autopilot.origin = (*HOME, 488.0)
    autopilot.rc = {9: 1100}
    bridge = run(config(autopilot.port, mode="rc"), autopilot)
    assert sleep_until(lambda: bridge.state().origin is not None, 30.0)
    feed(bridge, lambda: int(bridge.counters().get("bridge_shadowed") or 0) >= 6)
    assert autopilot.of("VISION_POSITION_ESTIMATE") == []
    autopilot.rc = {9: 1900}
    assert sleep_until(lambda: bridge.injecting, 30.0)
    feed(bridge, more(autopilot, 4))
    # A receiver that falls silent takes no position away; the switch does.
    autopilot.rc = {}
    feed(bridge, more(autopilot, 20))
    assert bridge.injecting
    autopilot.rc = {9: 1100}
    assert sleep_until(lambda: not bridge.injecting, 30.0)
    switched = [a.id for a in bridge.alerts() if a.values == (RcChannel(9),)]
    assert switched == [AlertId.INJECTION_ON, AlertId.INJECTION_OFF]


def test_health_follows_into_heartbeats_and_texts_on_transitions_only(autopilot, run):
    bridge = run(config(autopilot.port), autopilot)
    for _ in range(5):
        bridge.set_health(HealthLevel.FAILED, [alert(AlertId.LOST, seconds=3.0)])

    def states() -> set[int]:
        beats = autopilot.of("HEARTBEAT", component=197)
        return {m.system_status for m in beats}

    assert sleep_until(lambda: mavlink.MAV_STATE_EMERGENCY in states(), 30.0)
    lost = text(alert(AlertId.LOST, seconds=3.0))
    assert [m.text for m in autopilot.of("STATUSTEXT")].count(lost) == 1


def test_targets_go_to_the_ground_link_and_the_map_and_not_to_the_flight_controller(
    autopilot, ground, run
):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(30.0)
        map_at = f"127.0.0.1:{listener.getsockname()[1]}"
        settings = config(
            autopilot.port,
            ground_connection=f"udpout:127.0.0.1:{ground.port}",
            targets=TargetsConfig(adsb=True, cot_endpoint=map_at),
        )
        bridge = run(settings, autopilot)
        place = (HOME[0] + 0.001, HOME[1], 500.0 + GEOID)

        def reported() -> bool:
            bridge.report(TargetReport(time.monotonic_ns(), *place, pixel=(0.4, 0.6), target_id=3))
            return len(ground.of("CAMERA_TRACKING_GEO_STATUS")) > 2

        assert sleep_until(reported, 30.0, step_s=0.05)
        event = ElementTree.fromstring(listener.recv(65536))
    m = ground.of("CAMERA_TRACKING_GEO_STATUS")[-1]
    assert (m.get_srcSystem(), m.get_srcComponent()) == (1, 100)
    assert (m.lat, m.alt) == (round(place[0] * 1e7), 500.0)
    image = ground.of("CAMERA_TRACKING_IMAGE_STATUS")[-1]
    assert (image.point_x, image.point_y) == pytest.approx((0.4, 0.6))
    assert ground.of("ADSB_VEHICLE")
    assert event.attrib["uid"] == "pilot-target-3"
    assert event.attrib["time"] < event.attrib["stale"]
    assert float(event.find("point").attrib["hae"]) == pytest.approx(547.0)
    assert not autopilot.of("CAMERA_TRACKING_GEO_STATUS")
    assert not autopilot.of("ADSB_VEHICLE")


def test_signed_link(make_autopilot: Any, run: Callable[..., Bridge], tmp_path: Path) -> None:
    key = create_key(tmp_path / "key")
    signed = make_autopilot(key=key)
    settings = config(signed.port, signing=SigningConfig(key_file=tmp_path / "key"))
    bridge = run(settings, signed)
    heartbeats = signed.wait_for("HEARTBEAT", 3)
    assert all(m.get_signed() for m in heartbeats)
    assert bridge.counters()["fc_bad_signatures"] == 0
    unsigned = mavlink.MAVLink(None, 1, 1)
    attitude = mavlink.MAVLink_attitude_message(signed.boot_ms, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
    signed.send_bytes(attitude.pack(unsigned))
    assert sleep_until(lambda: bridge.counters()["fc_unsigned"] == 1, 30.0)


def test_signing_vehicle_that_does_not_know_the_time(make_autopilot, run, tmp_path):
    """Without GNSS it signs with last year's stamps, until it has heard newer ones: from us."""
    key = create_key(tmp_path / "key")
    vehicle = make_autopilot(key=key)
    vehicle.codec.signing.timestamp -= 365 * 86_400 * 100_000
    settings = BridgeConfig(connection=LISTENING, signing=SigningConfig(key_file=tmp_path / "key"))
    bridge = run(settings, vehicle)
    assert int(bridge.counters()["fc_bad_signatures"] or 0) > 0
    assert bridge.state().system_id == 1
    assert sleep_until(lambda: bridge.attitude_at(time.monotonic_ns()) is not None, 30.0)


def test_threads_end_with_the_bridge(autopilot: Any, run: Callable[..., Bridge]) -> None:
    before = set(threading.enumerate())
    bridge = run(config(autopilot.port), autopilot)
    assert len(set(threading.enumerate()) - before) == 1
    bridge.stop()
    assert set(threading.enumerate()) <= before
    with pytest.raises(BridgeStateError, match="already started"):
        bridge.start()


def test_the_operators_hint_comes_from_authorised_systems_only_and_is_no_position(
    autopilot: Any, ground: Any, run: Callable[..., Bridge]
) -> None:
    heard: list[PlaceHint] = []

    def take(hint: PlaceHint) -> bool:
        heard.append(hint)
        return hint.latitude_deg > 0

    settings = config(autopilot.port, ground_connection=f"udpout:127.0.0.1:{ground.port}")
    run(settings, autopilot, on_hint=take)
    assert sleep_until(lambda: ground.peer is not None, 30.0)
    number, nan = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, math.nan
    whole, frame = mavlink.MAVLink_command_int_message, mavlink.MAV_FRAME_GLOBAL

    def answer(message: Any, system: int = 255) -> int:
        before = len(ground.of("COMMAND_ACK"))
        ground.send(message, system=system)
        assert sleep_until(lambda: len(ground.of("COMMAND_ACK")) > before, 30.0)
        ack = ground.of("COMMAND_ACK")[-1]
        assert (ack.command, ack.get_srcComponent(), ack.target_system) == (number, 197, system)
        return int(ack.result)

    def place(x: int, y: int, sigma_m: float = 40.0, frame: int = frame) -> Any:
        return whole(1, 197, frame, number, 0, 0, 0.0, 0.0, sigma_m, nan, x, y, nan)

    there = (473980000, 85460000)
    accepted, denied = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
    assert answer(place(*there)) == accepted
    assert (heard[0].latitude_deg, heard[0].longitude_deg) == pytest.approx((47.398, 8.546))
    assert answer(place(*there), system=66) == denied  # a stranger's
    assert answer(place(0, 0)) == denied  # not filled in
    assert answer(place(*there, frame=mavlink.MAV_FRAME_LOCAL_NED)) == denied  # metres
    assert answer(place(2147483647, 2147483647)) == denied  # "not set"
    assert len(heard) == 1
    assert answer(place(-473980000, 85460000)) == denied  # not on the map, says who knows it
    long = mavlink.MAVLink_command_long_message(
        1, 197, number, 0, 0.0, 0.0, nan, nan, 47.398, 8.546, nan
    )
    assert answer(long) == accepted
    assert heard[-1].latitude_deg == pytest.approx(47.398, abs=2e-5)
    assert [answer(place(*there, sigma_m)) for sigma_m in (0.1, 1e9)] == [accepted] * 2
    assert [hint.radius_m for hint in heard] == [40.0, 40.0, 100.0, 10.0, 20_000.0]
    for kind in ("VISION_POSITION_ESTIMATE", "GPS_INPUT", "ODOMETRY", "COMMAND_INT"):
        assert not autopilot.of(kind)  # nothing was injected, nothing passed on
