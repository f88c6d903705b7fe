"""The whole bridge against a small autopilot over UDP loopback."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, HealthLevel, TargetReport, TrackRequest, VisionFix
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import InjectionOrder, RcChannel
from mavlink_bridge.config import InjectionConfig, OriginConfig, SigningConfig, TargetsConfig
from mavlink_bridge.errors import BridgeStateError
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.link.signing import create_key
from mavlink_bridge.messages import PlaceHint

HOME = (47.397742, 8.545594)
GEOID = 47.0
LISTENING = "udpin:127.0.0.1:0"
ORIGIN = OriginConfig(latitude_deg=HOME[0], longitude_deg=HOME[1], altitude_amsl_m=488.0)


def config(port: int, **options: Any) -> BridgeConfig:
    options.setdefault("origin", ORIGIN)
    options.setdefault("mode", "inject")
    options.setdefault("injection", InjectionConfig(rate_hz=20, delay_ms=30))
    return BridgeConfig(connection=f"udpout:127.0.0.1:{port}", **options)


class GroundStation:
    """Listens on UDP for what the bridge's ground link says."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(0.1)
        self.port = self.socket.getsockname()[1]
        self.codec = mavlink.MAVLink(None, 255, 190)
        self.received: list[Any] = []
        self.peer: Any = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                data, self.peer = self.socket.recvfrom(65536)
            except TimeoutError:
                continue
            self.received += self.codec.parse_buffer(data) or []

    def of(self, name: str) -> list[Any]:
        return [m for m in list(self.received) if m.get_type() == name]

    def send(self, message: Any, system: int = 255) -> None:
        codec = self.codec if system == 255 else mavlink.MAVLink(None, system, 190)
        self.socket.sendto(message.pack(codec), self.peer)

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()
        self.socket.close()


@pytest.fixture
def ground() -> Iterator[GroundStation]:
    station = GroundStation()
    yield station
    station.stop()


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


def feed(bridge: Bridge, until: Callable[[], bool], **options: Any) -> None:
    """Fixes at 20 Hz until something has come of them."""
    options.setdefault("quaternion", (1.0, 0.0, 0.0, 0.0))

    def fed() -> bool:
        bridge.submit(make_fix(**options))
        return until()

    assert sleep_until(fed, 30.0, step_s=0.05), bridge.counters()


def more(autopilot: Any, count: int) -> Callable[[], bool]:
    """Whether so many more positions have come."""
    wanted = len(autopilot.of("VISION_POSITION_ESTIMATE")) + count
    return lambda: len(autopilot.of("VISION_POSITION_ESTIMATE")) >= wanted


def shadowed(bridge: Bridge, count: int) -> Callable[[], bool]:
    """Whether so many more positions were withheld in shadow."""

    def now() -> int:
        return int(bridge.counters().get("bridge_shadowed", 0))

    wanted = now() + count
    return lambda: now() >= wanted


def switched(bridge: Bridge, by: RcChannel | InjectionOrder) -> list[AlertId]:
    """How this switched injection, in order."""
    return [a.id for a in bridge.alerts() if a.values == (by,)]


def make_fix(**options: Any) -> VisionFix:
    options.setdefault("time_ns", time.monotonic_ns() - 20_000_000)
    options.setdefault("position_covariance_ned", np.eye(3) * 0.25)
    return VisionFix(
        latitude_deg=HOME[0], longitude_deg=HOME[1], height_m=488.0 + GEOID + 60.0, **options
    )


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
    feed(bridge, shadowed(bridge, 6))
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
    assert switched(bridge, RcChannel(9)) == [AlertId.INJECTION_ON, AlertId.INJECTION_OFF]


@pytest.mark.parametrize("over_ground", [False, True])
def test_command_gates_injection(over_ground, autopilot, ground, run):
    autopilot.origin = (*HOME, 488.0)
    connection = f"udpout:127.0.0.1:{ground.port}" if over_ground else None
    bridge = run(config(autopilot.port, mode="rc", ground_connection=connection), autopilot)
    assert sleep_until(lambda: bridge.state().origin is not None, 30.0)
    station: Any = ground if over_ground else autopilot
    assert sleep_until(lambda: not over_ground or ground.peer is not None, 30.0)

    def ask(command: int, wanted: float, *, system: int = 1, component: int = 197) -> int:
        before = len(station.of("COMMAND_ACK"))
        message = mavlink.MAVLink_command_long_message(
            system, component, command, 0, wanted, 0, 0, 0, 0, 0, 0
        )
        if over_ground:
            ground.send(message)
        else:
            autopilot.send(message, component=190, system=255)
        patience_s = 1.0 if system == 2 else 30.0  # nobody answers for another vehicle
        if not sleep_until(lambda: len(station.of("COMMAND_ACK")) > before, patience_s):
            return -1
        ack = station.of("COMMAND_ACK")[-1]
        assert (ack.command, ack.get_srcComponent(), ack.target_system) == (command, 197, 255)
        return int(ack.result)

    assert not bridge.injecting
    assert ask(mavlink.MAV_CMD_USER_1, 1.0, system=2) == -1  # another vehicle's
    assert ask(mavlink.MAV_CMD_USER_2, 1.0) == mavlink.MAV_RESULT_UNSUPPORTED
    assert ask(mavlink.MAV_CMD_USER_1, math.nan) == mavlink.MAV_RESULT_DENIED
    assert not bridge.injecting
    assert ask(mavlink.MAV_CMD_USER_1, 1.0) == mavlink.MAV_RESULT_ACCEPTED
    assert ask(mavlink.MAV_CMD_USER_1, 1.0) == mavlink.MAV_RESULT_ACCEPTED  # sent again
    assert sleep_until(lambda: bridge.injecting, 30.0)  # from the other link's next turn on
    feed(bridge, more(autopilot, 4))
    assert ask(mavlink.MAV_CMD_USER_1, 0.0) == mavlink.MAV_RESULT_ACCEPTED
    assert not bridge.injecting
    assert switched(bridge, InjectionOrder.COMMAND) == [AlertId.INJECTION_ON, AlertId.INJECTION_OFF]


def test_health_follows_into_heartbeats_and_texts_on_transitions_only(autopilot, run):
    bridge = run(config(autopilot.port), autopilot)
    for _ in range(5):
        bridge.set_health(HealthLevel.FAILED, [alert(AlertId.LOST, seconds=3.0)])
    assert sleep_until(
        lambda: any(
            m.system_status == mavlink.MAV_STATE_EMERGENCY
            for m in autopilot.of("HEARTBEAT")
            if m.get_srcComponent() == 197
        ),
        30.0,
    )
    lost = text(alert(AlertId.LOST, seconds=3.0))
    assert [m.text for m in autopilot.of("STATUSTEXT")].count(lost) == 1


def test_timesync_requests_are_answered_on_our_clock(autopilot, run):
    run(config(autopilot.port), autopilot)
    begun_ns = time.monotonic_ns()
    autopilot.send(mavlink.MAVLink_timesync_message(0, 123456789))
    assert sleep_until(
        lambda: any(m.ts1 == 123456789 and m.tc1 != 0 for m in autopilot.of("TIMESYNC")), 30.0
    )
    answer = next(m for m in autopilot.of("TIMESYNC") if m.tc1 != 0)
    assert begun_ns <= answer.tc1 <= time.monotonic_ns()


def report(**options: Any) -> TargetReport:
    return TargetReport(
        time.monotonic_ns(),
        HOME[0] + 0.001,
        HOME[1],
        500.0 + GEOID,
        h_accuracy_m=2.5,
        v_accuracy_m=1.5,
        pixel=(0.4, 0.6),
        **options,
    )


def test_targets_go_to_the_ground_link_and_not_to_the_flight_controller(autopilot, ground, run):
    settings = config(
        autopilot.port,
        ground_connection=f"udpout:127.0.0.1:{ground.port}",
        targets=TargetsConfig(adsb=True),
    )
    bridge = run(settings, autopilot)

    def reported() -> bool:
        bridge.report(report(velocity_ned=(3.0, 4.0, 0.0), target_id=3))
        return len(ground.of("CAMERA_TRACKING_GEO_STATUS")) > 2

    assert sleep_until(reported, 30.0, step_s=0.05)
    m = ground.of("CAMERA_TRACKING_GEO_STATUS")[-1]
    assert m.get_srcComponent() == 100
    assert m.get_srcSystem() == 1
    assert m.lat == round((HOME[0] + 0.001) * 1e7)
    assert m.alt == pytest.approx(500.0)
    assert (m.h_acc, m.v_acc) == (2.5, 1.5)
    assert m.hdg == pytest.approx(math.atan2(4.0, 3.0))
    image = ground.of("CAMERA_TRACKING_IMAGE_STATUS")[-1]
    assert (image.point_x, image.point_y) == pytest.approx((0.4, 0.6))
    adsb = ground.of("ADSB_VEHICLE")[-1]
    assert adsb.hor_velocity == 500
    assert adsb.heading == pytest.approx(5313, abs=1)
    assert not autopilot.of("CAMERA_TRACKING_GEO_STATUS")
    assert not autopilot.of("ADSB_VEHICLE")


def test_camera_protocol(autopilot: Any, ground: GroundStation, run: Callable[..., Bridge]) -> None:
    asked: list[TrackRequest] = []
    settings = config(autopilot.port, ground_connection=f"udpout:127.0.0.1:{ground.port}")
    run(settings, autopilot, on_track=asked.append)
    assert sleep_until(lambda: ground.peer is not None, 30.0)

    def command(number: int, *parameters: float, component: int = 100) -> None:
        padded = [*parameters, *([0.0] * (7 - len(parameters)))]
        ground.send(mavlink.MAVLink_command_long_message(1, component, number, 0, *padded))

    command(mavlink.MAV_CMD_REQUEST_MESSAGE, 259)
    assert sleep_until(lambda: len(ground.of("CAMERA_INFORMATION")) == 1, 30.0)
    information = ground.of("CAMERA_INFORMATION")[0]
    assert information.flags & mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
    assert bytes(information.model_name).rstrip(b"\0") == b"map camera"
    command(mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 1)
    assert sleep_until(lambda: len(ground.of("VIDEO_STREAM_INFORMATION")) == 1, 30.0)
    command(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.25, 0.75, 0.1)
    command(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, 0.1, 0.2, 0.3, 0.4)
    command(mavlink.MAV_CMD_CAMERA_STOP_TRACKING)
    command(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 1.5, math.nan)  # outside the picture
    command(mavlink.MAV_CMD_CAMERA_TRACK_POINT, 0.5, 0.5, component=1)  # not for the camera
    assert sleep_until(lambda: len(ground.of("COMMAND_ACK")) == 6, 30.0)
    assert [r.kind for r in asked] == ["point", "rectangle", "stop"]
    assert asked[0].coordinates == pytest.approx((0.25, 0.75))
    results = [m.result for m in ground.of("COMMAND_ACK")]
    assert results == [0, 0, 0, 0, 0, mavlink.MAV_RESULT_DENIED]
    assert all(m.target_system == 255 for m in ground.of("COMMAND_ACK"))


def test_cursor_on_target(autopilot: Any, run: Callable[..., Bridge]) -> None:
    from xml.etree import ElementTree

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(30.0)
        targets = TargetsConfig(cot_endpoint=f"127.0.0.1:{listener.getsockname()[1]}")
        bridge = run(config(autopilot.port, targets=targets), autopilot)
        bridge.report(report(target_id=9))
        event = ElementTree.fromstring(listener.recv(65536))
        bridge.report(report(target_id=9, elsewhere=0.3))
        ambiguous = ElementTree.fromstring(listener.recv(65536))
    point = event.find("point")
    assert float(point.attrib["lat"]) == pytest.approx(HOME[0] + 0.001)
    assert float(point.attrib["hae"]) == pytest.approx(547.0)
    assert (point.attrib["ce"], point.attrib["le"]) == ("2.5", "1.5")
    assert event.attrib["uid"] == "pilot-target-9"
    assert event.find("detail/remarks") is None
    assert "30% likely on another surface" in (ambiguous.findtext("detail/remarks") or "")
    assert event.attrib["time"] < event.attrib["stale"]


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


@pytest.mark.parametrize("noise", [b"GET / HTTP/1.1", b"\x00" * 20])
def test_a_stray_datagram_does_not_take_the_vehicles_place(noise, autopilot, run):
    bridge = run(BridgeConfig(connection=LISTENING), autopilot)
    autopilot.streaming = False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(noise, autopilot.peer)
        assert sleep_until(lambda: bridge.counters()["fc_rx_of_strangers"] == 1, 30.0)
        heartbeats = len(autopilot.of("HEARTBEAT"))
        assert sleep_until(lambda: len(autopilot.of("HEARTBEAT")) > heartbeats + 3, 30.0)


def test_threads_end_with_the_bridge(autopilot: Any, run: Callable[..., Bridge]) -> None:
    before = set(threading.enumerate())
    bridge = run(config(autopilot.port), autopilot)
    assert len(set(threading.enumerate()) - before) == 1
    bridge.stop()
    assert set(threading.enumerate()) <= before
    with pytest.raises(BridgeStateError, match="already started"):
        bridge.start()


def test_the_operators_hint_comes_from_authorised_systems_only_and_is_no_position(
    autopilot: Any, ground: GroundStation, run: Callable[..., Bridge]
) -> None:
    heard: list[PlaceHint] = []

    def take(hint: PlaceHint) -> bool:
        heard.append(hint)
        return hint.latitude_deg > 0

    settings = config(
        autopilot.port, ground_connection=f"udpout:127.0.0.1:{ground.port}", mode="inject"
    )
    run(settings, autopilot, on_hint=take)
    assert sleep_until(lambda: ground.peer is not None, 30.0)
    number, nan = mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, math.nan
    whole, frame = mavlink.MAVLink_command_int_message, mavlink.MAV_FRAME_GLOBAL

    def answer(message: Any, system: int = 255) -> int:
        before = len(ground.of("COMMAND_ACK"))
        ground.send(message, system=system)
        assert sleep_until(lambda: len(ground.of("COMMAND_ACK")) > before, 30.0)
        ack = ground.of("COMMAND_ACK")[-1]
        assert (ack.command, ack.get_srcComponent()) == (number, 197)
        return int(ack.result)

    def place(x: int, y: int, sigma_m: float = 40.0) -> Any:
        return whole(1, 197, frame, number, 0, 0, 0.0, 0.0, sigma_m, nan, x, y, nan)

    accepted, denied = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
    assert answer(place(473980000, 85460000)) == accepted
    assert (heard[0].latitude_deg, heard[0].longitude_deg) == pytest.approx((47.398, 8.546))
    assert heard[0].radius_m == 40.0
    assert answer(place(473980000, 85460000), system=66) == denied  # a stranger's
    assert answer(place(0, 0)) == denied  # not filled in
    local = whole(1, 197, mavlink.MAV_FRAME_LOCAL_NED, number, 0, 0, 0.0, 0.0, 40.0, nan,
                  473980000, 85460000, nan)  # fmt: skip
    assert answer(local) == denied  # metres
    assert answer(place(2147483647, 2147483647)) == denied  # "not set"
    assert len(heard) == 1
    assert answer(place(-473980000, 85460000)) == denied  # not on the map, says who knows it
    long = mavlink.MAVLink_command_long_message(
        1, 197, number, 0, 0.0, 0.0, nan, nan, 47.398, 8.546, nan
    )
    assert answer(long) == accepted
    assert heard[-1].latitude_deg == pytest.approx(47.398, abs=2e-5)
    assert heard[-1].radius_m > 50.0  # an unknown one is large
    for kind in ("VISION_POSITION_ESTIMATE", "GPS_INPUT", "ODOMETRY", "COMMAND_INT"):
        assert not autopilot.of(kind)  # nothing was injected, nothing passed on
