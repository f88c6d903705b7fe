"""What ground stations are shown beside the camera protocol: CoT, marks, figures, texts, video."""

import json
import math
import socket
import threading
from itertools import count
from pathlib import Path

import pytest
from lxml import etree
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import Bridge, BridgeConfig, CameraView, TargetReport
from mavlink_bridge import quaternion as quat
from mavlink_bridge.alerts.catalogue import alert, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.camera.component import CameraComponent
from mavlink_bridge.camera.cursor_on_target import (
    CursorOnTarget,
    aircraft_on_map,
    cursor_on_target,
    sensor_angles,
)
from mavlink_bridge.camera.look_at import LOOKS
from mavlink_bridge.camera.messages import camera_information, video_stream_information
from mavlink_bridge.config import CameraConfig, TargetsConfig
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.link.transport import UdpTransport

SECOND = 10**9
ROOT = Path(__file__).parents[2]
UTC = SteadyUtc(at_monotonic_ns=0, utc_ns=1_790_000_000 * SECOND)
CAMERA = CameraConfig(stream_uri="rtsp://10.0.0.2:8554/main", horizontal_fov_deg=60.0)
COT = TargetsConfig(cot_endpoint="127.0.0.1:9", cot_aircraft=True, cot_callsign="UAS 7")


def view(roll_deg=0.0, pitch_deg=-45.0, yaw_deg=90.0, **changes):
    q = quat.from_euler(*(math.radians(a) for a in (roll_deg, pitch_deg, yaw_deg)))
    given = {
        "time_ns": SECOND, "latitude_deg": 47.0, "longitude_deg": 8.0, "height_m": 600.0,
        "quaternion_ned": q, "image_latitude_deg": 47.0, "image_longitude_deg": 8.002,
        "image_height_m": 450.0, "h_accuracy_m": 0.5, "v_accuracy_m": 0.7,
    }  # fmt: skip
    return CameraView(**(given | changes))


def test_every_event_passes_the_published_schema_and_a_broken_one_does_not():
    schema = etree.XMLSchema(etree.parse(Path(__file__).with_name("cot_event.xsd")))
    target = TargetReport(SECOND, -33.5, 151.0, 20.0, (3.0, -4.0, 0.0), 2.5, 1.5, elsewhere=0.2)
    events = [
        cursor_on_target(target, COT, UTC),
        cursor_on_target(TargetReport(SECOND, 47.0, 8.0, 450.0), COT, UTC),
        aircraft_on_map(view(), COT, CAMERA, UTC),
        aircraft_on_map(
            view(image_latitude_deg=None, image_longitude_deg=None, image_height_m=None),
            COT, CAMERA.model_copy(update={"stream_uri": "5600"}), UTC,
        ),
    ]  # fmt: skip
    for event in events:
        schema.assertValid(etree.fromstring(event))
    remarks = [etree.fromstring(event).findtext("detail/remarks") for event in events]
    assert remarks == ["20% likely on another surface (edge in the image)", None, None, None]
    for broken in (b'lat="-33', b'stale="2', b'version="2.0"'):
        assert broken in events[0]
        wrong = events[0].replace(
            broken, {b"l": b'lat="-93', b"s": b'stale="x'}.get(broken[:1], b"")
        )
        assert not schema.validate(etree.fromstring(wrong))


def test_the_aircraft_its_wedge_and_its_video():
    event = etree.fromstring(aircraft_on_map(view(), COT, CAMERA, UTC))
    assert event.get("type").startswith("a-f-A")
    assert event.find("detail/contact").get("callsign") == "UAS 7"
    point = event.find("point")
    assert (point.get("lat"), point.get("hae"), point.get("ce")) == ("47.0000000", "600.00", "0.5")
    sensor = event.find("detail/sensor")
    assert float(sensor.get("azimuth")) == pytest.approx(90.0)
    assert float(sensor.get("elevation")) == pytest.approx(-45.0)
    assert (sensor.get("fov"), sensor.get("vfov")) == ("60.0", "36.0")
    assert float(sensor.get("range")) == pytest.approx(151.8, abs=1.5)  # 0.002 degrees at 47 north
    assert event.find("detail/__video").get("url") == "rtsp://10.0.0.2:8554/main"
    sky = aircraft_on_map(
        view(pitch_deg=10.0, image_latitude_deg=None, image_longitude_deg=None), COT, CAMERA, UTC
    )
    assert etree.fromstring(sky).find("detail/sensor").get("range") is None


@pytest.mark.parametrize("pitch", [-90.0, -89.9, -75.0, -45.0, 0.0])
@pytest.mark.parametrize("yaw", [0.0, 123.0, 359.0])
def test_the_wedge_points_where_the_picture_does_down_to_the_nadir(pitch, yaw):
    q = view(pitch_deg=pitch, yaw_deg=yaw).quaternion_ned
    azimuth, elevation, _ = sensor_angles(q)
    assert abs((azimuth - yaw + 180.0) % 360.0 - 180.0) < 0.01
    assert elevation == pytest.approx(pitch, abs=0.01)


def test_the_aircraft_is_sent_once_a_second_and_only_where_it_is_wanted():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(30.0)
        endpoint = f"127.0.0.1:{listener.getsockname()[1]}"
        wanted = COT.model_copy(update={"cot_endpoint": endpoint})
        for config, expected in (
            (wanted, 3),
            (wanted.model_copy(update={"cot_aircraft": False}), 0),
        ):
            cot = CursorOnTarget(config, CAMERA, UTC)
            for k in range(15):  # three seconds at 5 Hz
                cot.report_view(view(time_ns=SECOND + k * SECOND // 5))
            cot.send(TargetReport(SECOND, 47.0, 8.0, 450.0, target_id=3))
            cot.close()
            got = [etree.fromstring(listener.recv(65536)).get("uid") for _ in range(expected + 1)]
            assert got == ["pilot-aircraft-UAS 7"] * expected + ["pilot-target-3"]


def test_the_ground_stations_name_is_resolved_again_only_after_an_error(monkeypatch):
    """Each event asked the name server, on the thread that sends the targets."""
    asked, sent = [], []
    monkeypatch.setattr(socket, "gethostbyname", lambda name: asked.append(name) or "127.0.0.1")

    def send(transport, data):
        sent.append(data)
        if len(sent) == 2:
            raise OSError("network is unreachable")
        return len(data)

    monkeypatch.setattr(UdpTransport, "write", send)
    cot = CursorOnTarget(COT.model_copy(update={"cot_endpoint": "station:9"}), CAMERA, UTC)
    for _ in range(4):
        cot.send(TargetReport(SECOND, 47.0, 8.0, 450.0, target_id=3))
    cot.close()
    assert asked == ["station"] * 2
    assert len(sent) == 4


def test_closing_does_not_wait_for_a_name_server(monkeypatch):
    """It would keep the bridge from ending, and the record after it."""
    asked, closed, order = threading.Event(), threading.Event(), []

    def resolve(_name):
        asked.set()
        order.append("closed" if closed.wait(5.0) else "gave up")
        raise OSError("no answer")

    monkeypatch.setattr(socket, "gethostbyname", resolve)
    cot = CursorOnTarget(COT.model_copy(update={"cot_endpoint": "station:9"}), CAMERA, UTC)
    sender = threading.Thread(target=cot.send, args=(TargetReport(SECOND, 47.0, 8.0, 450.0),))
    sender.start()
    assert asked.wait(30.0)
    cot.close()
    closed.set()
    sender.join()
    assert order == ["closed"]


def _marks(reports, **targets):
    component = CameraComponent(
        BridgeConfig(targets=TargetsConfig(**targets)),
        47.5,
        None,
        count(1),
        ground_link=True,
        utc=UTC,
    )
    marks = []

    def send(message, _):
        if message.get_type() == "CAMERA_IMAGE_CAPTURED":
            marks.append(message)
        return True

    for k, report in enumerate(reports):
        component.report(report)
        component.tick(SECOND + k, None, 7, send)
    for k in range(60):  # what was lost is said again, and then no more
        component.tick(SECOND + k * SECOND // 4, None, 7, send)
    return marks


def test_a_mark_for_each_confirmed_target_three_times_where_it_is_wanted():
    def seen(number, **changes):
        given = {"h_accuracy_m": 1.0, "target_id": number, "pixel": (0.5, 0.5)} | changes
        return TargetReport(SECOND, 47.1, 8.1, 450.0, **given)

    reports = [
        seen(1, h_accuracy_m=4.0), seen(1, h_accuracy_m=None), seen(1, elsewhere=0.3),
        seen(1, coasting=True), seen(1), seen(1), seen(2), seen(1),
    ]  # fmt: skip
    marks = _marks(reports, captured=True)
    assert sorted(m.image_index for m in marks) == [0, 0, 0, 1, 1, 1]
    assert {(m.lat, m.lon) for m in marks} == {(471000000, 81000000)}
    assert marks[0].alt == 402_500
    assert marks[0].time_utc == 1_790_000_001_000_000
    assert marks[0].capture_result == 1
    assert _marks(reports) == []


@pytest.mark.parametrize(
    ("uri", "kind", "told"),
    [
        ("rtsp://10.0.0.2:8554/main", "RTSP", "rtsp://10.0.0.2:8554/main"),
        ("udp://0.0.0.0:5600", "MPEG_TS", "5600"),
        ("udp://239.1.1.1:5600?pkt_size=1316", "MPEG_TS", "5600"),
        ("5600", "MPEG_TS", "5600"),
        ("tcp://10.0.0.2:5601", "TCP_MPEG", "10.0.0.2:5601"),
    ],
)
def test_a_video_is_announced_as_stations_open_it(uri, kind, told):
    message = video_stream_information(CameraConfig(stream_uri=uri))
    assert message.type == getattr(mavlink, f"VIDEO_STREAM_TYPE_{kind}")
    assert message.uri == told
    has_video = mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    assert camera_information(CameraConfig(stream_uri=uri), 0).flags & has_video
    assert not camera_information(CameraConfig(), 0).flags & has_video


@pytest.mark.parametrize("as_autopilot", [False, True])
def test_warnings_reach_a_station_that_hears_the_autopilot_only(autopilot, ground, as_autopilot):
    """As MAVProxy reads STATUSTEXT: of the target system's target component (1) and no other."""
    config = BridgeConfig(
        connection="udpin:127.0.0.1:0",
        ground_connection=f"udpout:127.0.0.1:{ground.port}",
        texts_as_autopilot=as_autopilot,
        named_values=True,
    )
    with Bridge(config, 47.5) as bridge:
        assert sleep_until(lambda: bridge.port is not None, 30.0)
        autopilot.peer = ("127.0.0.1", bridge.port)
        assert sleep_until(lambda: bridge.state().connected, 30.0)
        assert sleep_until(lambda: bool(ground.received), 30.0)  # its link knows whose it is
        bridge.report_alert(alert(AlertId.FC_LOST))
        bridge.report_alert(alert(AlertId.FC_BACK))
        bridge.send_named_values({"VPS_SIGNAL": 2.0, "VPS_AGE": 0.25})
        assert sleep_until(lambda: len(ground.of("NAMED_VALUE_FLOAT")) == 2, 30.0)
        figures = [(m.name, m.value, m.get_srcComponent()) for m in ground.of("NAMED_VALUE_FLOAT")]
        assert figures == [("VPS_SIGNAL", 2.0, 191), ("VPS_AGE", 0.25, 191)]
        sources = [(m.text, m.get_srcComponent() == 1) for m in ground.of("STATUSTEXT")]
        told = (AlertId.FC_LOST, as_autopilot), (AlertId.FC_BACK, False)
        assert sources[-2:] == [(text(alert(of)), shown) for of, shown in told]
        with pytest.raises(ValueError, match="10 characters"):
            bridge.send_named_values({"VPS_SIGNALS": 1.0})


def test_the_buttons_for_qgroundcontrol_are_commands_that_our_components_take():
    document = json.loads((ROOT / "configs" / "qgc-mavlink-actions.json").read_text())
    assert (document["version"], document["fileType"]) == (1, "MavlinkActions")
    config = BridgeConfig()
    ours = {
        config.localizer_component: {mavlink.MAV_CMD_USER_1},
        config.camera_component: {mavlink.MAV_CMD_CAMERA_STOP_TRACKING, *LOOKS},
    }
    for action in document["actions"]:
        assert action["mavCmd"] in ours[action["compId"]]
        assert action["label"]
        assert action["description"]
