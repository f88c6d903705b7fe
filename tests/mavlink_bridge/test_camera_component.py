"""What the camera component tells of targets, and that an ended one is told no more."""

import math
from itertools import count
from types import SimpleNamespace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.camera.component import CameraComponent, Marks
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import TargetReport

SECOND = 10**9


def test_a_target_that_is_forgotten_is_told_no_more_and_the_others_are():
    component = CameraComponent(BridgeConfig(), 47.5, None, count(1), ground_link=True)
    sent: list[Any] = []

    def told(now_ns):
        sent.clear()
        component.tick(now_ns, None, 0, lambda message, _: sent.append(message) or True)
        return [m.lat for m in sent if m.get_type() == "CAMERA_TRACKING_GEO_STATUS"]

    for number, latitude in ((3, 47.3), (4, 47.4)):
        component.report(TargetReport(10 * SECOND, latitude, 8.5, 450.0, target_id=number))
    assert sorted(told(10 * SECOND)) == [473000000, 474000000]
    component.forget(3)
    component.forget(7)  # never reported: no error
    assert told(11 * SECOND) == [474000000]
    component.forget(4)
    assert told(11 * SECOND + SECOND // 2) == []


def test_marks_of_fresh_targets_without_end_take_no_memory_without_end():
    """A detector that names each thing anew: each is marked three times, with its own index."""
    marks, seen = Marks(3.0), []
    for number in range(1, 601):
        for k in range(4):
            now_ns = (number * 10 + k * 2) * SECOND
            report = TargetReport(now_ns, 47.3, 8.5, 450.0, h_accuracy_m=0.5, target_id=number)
            mark = marks.due({number: report}, now_ns)
            seen += [] if mark is None else [mark.index]
    assert seen == [index for index in range(600) for _ in range(3)]
    assert len(marks) <= 256


class Station:
    """A ground station's commands to the camera, and what it hears."""

    def __init__(self):
        self.asked: list[Any] = []
        self.heard: list[Any] = []
        self.camera = CameraComponent(
            BridgeConfig(), 47.5, self.asked.append, count(1), ground_link=True
        )

    def send(self, command, *parameters, confirmation=0, time_ns=SECOND):
        padded = [*parameters, *([0.0] * (7 - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(1, 100, command, confirmation, *padded)
        message.get_srcSystem, message.get_srcComponent = lambda: 255, lambda: 190
        self.heard.clear()
        self.camera.command(message, time_ns, 0, self._hear)
        return self.heard[-1]

    def hears(self, now_ns):
        self.heard.clear()
        self.camera.tick(now_ns, None, 0, self._hear)
        return self.heard

    def _hear(self, message, _):
        self.heard.append(message)
        return True


POINT, STOP = mavlink.MAV_CMD_CAMERA_TRACK_POINT, mavlink.MAV_CMD_CAMERA_STOP_TRACKING


def test_the_answer_to_a_click_says_its_number_and_a_repeated_command_begins_no_other():
    station = Station()
    assert station.send(POINT, 0.25, 0.5).result_param2 == 1
    assert station.send(POINT, 0.25, 0.5, confirmation=1).result_param2 == 1  # its ack was lost
    assert station.send(POINT, 0.25, 0.5).result_param2 == 2  # clicked again
    assert station.send(POINT, 0.75, 0.5, confirmation=1).result_param2 == 3
    assert [r.number for r in station.asked] == [1, 2, 3]
    station.send(STOP)
    station.send(STOP, 2.0)
    station.send(STOP, float("nan"))
    assert [r.number for r in station.asked[3:]] == [0, 2, 0]


def test_a_stations_questions_are_answered_and_what_is_no_request_is_denied():
    station = Station()
    assert station.send(mavlink.MAV_CMD_REQUEST_MESSAGE, 259.0).result == 0
    information = station.heard[0]
    assert information.flags & mavlink.CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS
    assert bytes(information.model_name).rstrip(b"\0") == b"map camera"
    assert station.send(mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 1.0).result == 0
    assert station.heard[0].get_type() == "VIDEO_STREAM_INFORMATION"
    assert station.send(POINT, 1.5, math.nan).result == mavlink.MAV_RESULT_DENIED
    corners = (0.1, 0.2, 0.3, 0.4)
    assert station.send(mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE, *corners).result == 0
    assert [(r.kind, r.coordinates) for r in station.asked] == [("rectangle", corners)]
    others: Any = SimpleNamespace(target_component=1)
    assert not station.camera.command(others, SECOND, 0, lambda *_: True)


def test_one_target_is_told_the_one_clicked_last_and_idle_only_when_it_ends():
    """The protocol has no number of a target: two boxes in turn are one box that jumps."""
    station = Station()
    for number, x in ((1, 0.1), (2, 0.2), (1001, 0.9)):
        report = TargetReport(
            SECOND, 47.0 + x, 8.5, 450.0, pixel=(x, 0.5), target_id=number, clicked=number < 1000
        )
        station.camera.report(report)

    def boxes(now_ns):
        told = [m for m in station.hears(now_ns) if m.get_type().startswith("CAMERA_TRACKING")]
        return [(m.get_type()[16:], round(getattr(m, "point_x", 0.0), 3)) for m in told]

    both = [("IMAGE_STATUS", 0.2), ("GEO_STATUS", 0.0)]
    assert boxes(SECOND) == both
    assert boxes(SECOND + SECOND // 4) == both
    station.camera.forget(2)
    assert boxes(SECOND + SECOND // 2) == [("IMAGE_STATUS", 0.1), ("GEO_STATUS", 0.0)]
    station.camera.forget(1)
    assert boxes(2 * SECOND)[0] == ("IMAGE_STATUS", 0.9)
    station.camera.forget(1001)
    idle = [len(boxes((3 + k) * SECOND)) for k in range(8)]
    assert sum(idle) == 3


def test_what_is_hidden_is_told_as_coasting():
    station = Station()
    station.camera.report(
        TargetReport(SECOND, 47.0, 8.5, 450.0, pixel=(0.5, 0.5), target_id=1, coasting=True)
    )
    coasting = mavlink.CAMERA_TRACKING_STATUS_FLAGS_COASTING
    assert [m.tracking_status & coasting for m in station.hears(SECOND)] == [coasting] * 2
