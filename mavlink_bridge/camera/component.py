"""The camera component on one link: answers commands and sends its status.

Commands must be addressed to the camera component itself; ArduPilot does not pass tracking commands
that are addressed to the autopilot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.camera.look_at import LOOKS, LookAt
from mavlink_bridge.camera.messages import (
    adsb_vehicle,
    camera_fov_status,
    camera_information,
    image_captured,
    is_confirmed,
    track_request,
    tracking_geo_status,
    tracking_image_status,
    video_stream_information,
)
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import CameraView, Origin, TargetReport, TrackRequest

Send = Callable[[Any, int], bool]
_TARGET_AGE_NS = 2_000_000_000
_IDLE_PERIOD_NS = 1_000_000_000
_IDLE_TIMES = 3  # "idle" is told when tracking ends, not for ever
_REPEATED_NS = 10_000_000_000  # how long a station repeats a command that nobody answered
TRACKING = frozenset(
    (
        mavlink.MAV_CMD_CAMERA_TRACK_POINT,
        mavlink.MAV_CMD_CAMERA_TRACK_RECTANGLE,
        mavlink.MAV_CMD_CAMERA_STOP_TRACKING,
    )
)
# Superseded by REQUEST_MESSAGE, still sent by ground stations.
_OLD_REQUESTS = {
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION,
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: (
        mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION
    ),
}
_MOST_CLICKS, _CLICKS_NS = 10, 5_000_000_000  # no hand is faster
_MIN_INTERVAL_US = 20_000
_MARK_AGAIN_NS = 2_000_000_000  # a mark is said three times: it may be lost, and no one asks again
_MOST_MARKS = 256  # remembered of targets that are gone, so that none is marked twice
_PER_TICK = 4  # targets: more in one go would fill a slow port, and positions wait behind them


class _ClickRate:
    """Limits the rate of clicks, because too many would end targets before they are located."""

    def __init__(self) -> None:
        self._times_ns: deque[int] = deque(maxlen=_MOST_CLICKS)

    def is_exceeded(self, time_ns: int) -> bool:
        """Count a click at time_ns; whether it is one too many, which is not counted."""
        times = self._times_ns
        if len(times) == _MOST_CLICKS and time_ns - times[0] < _CLICKS_NS:
            return True
        times.append(time_ns)
        return False


@dataclass
class TargetMark:
    """Position of a confirmed target. left: number of times it is still to be sent."""

    report: TargetReport
    index: int
    left: int = 3
    sent_ns: int = -_MARK_AGAIN_NS


class Marks:
    """Selects the next marker to send. Of ended targets only the newest 256 are kept, because a
    detector may name any number of targets.
    """

    def __init__(self, sigma_m: float) -> None:
        self._sigma_m = sigma_m
        self._marks: dict[int, TargetMark] = {}
        self._next = 0

    def __len__(self) -> int:
        return len(self._marks)

    def due(self, targets: Mapping[int, TargetReport], now_ns: int) -> TargetMark | None:
        """The target marker to send at now_ns, or None; the marker counts as sent. A marker is made
        once a target's sigma is small enough, and is sent three times. At most one is returned, so
        that a slow port still carries the positions.
        """
        for number, report in targets.items():
            if number not in self._marks and is_confirmed(report, self._sigma_m):
                self._marks[number] = TargetMark(report, self._next)
                self._next += 1
        gone = [number for number in self._marks if number not in targets]
        for number in gone[: max(0, len(self._marks) - _MOST_MARKS)]:
            del self._marks[number]
        for mark in self._marks.values():
            if mark.left and now_ns - mark.sent_ns >= _MARK_AGAIN_NS:
                mark.left, mark.sent_ns = mark.left - 1, now_ns
                return mark
        return None


class CameraComponent:
    """The camera component on one link; all methods run in the link's owner thread."""

    def __init__(
        self,
        config: BridgeConfig,
        geoid_separation_m: float,
        on_track: Callable[[TrackRequest], None] | None,
        numbers: Iterator[int],
        *,
        ground_link: bool,
        utc: SteadyUtc | None = None,
        look: LookAt | None = None,
    ) -> None:
        self._camera = config.camera
        self._utc, self._look = utc or SteadyUtc(), look
        sigma_m = config.targets.confirmed_sigma_m
        self._marks = Marks(sigma_m) if config.targets.captured else None
        self._component = config.camera_component
        self._adsb = config.targets.adsb and ground_link
        self._geoid_m = geoid_separation_m
        self._on_track = on_track
        self._numbers = numbers
        self._last_click: tuple[Any, int, TrackRequest] | None = None
        self._pace = _ClickRate()
        self._period_ns = int(1e9 / config.targets.rate_hz)
        self._image_ns = self._geo_ns = self._period_ns
        self._targets: dict[int, TargetReport] = {}
        self._sent_ns: dict[tuple[str, int], int] = {}
        self._view: CameraView | None = None
        self._view_sent_ns = 0
        self._idle_ns = 0
        self._idle_left = _IDLE_TIMES

    def report(self, target: TargetReport) -> None:
        """Set the newest fix of a target, to be sent by `tick`."""
        self._targets[target.target_id] = target

    def forget(self, target_id: int) -> None:
        """Stop reporting the target of this number."""
        self._targets.pop(target_id, None)
        for kind in ("image", "geo", "adsb"):
            self._sent_ns.pop((kind, target_id), None)

    def report_view(self, view: CameraView) -> None:
        """Set the newest camera pose, to be sent once by `tick`."""
        self._view = view

    def tick(self, now_ns: int, vehicle: Origin | None, uptime_ms: int, send: Send) -> None:
        """Send the messages that are due, after dropping targets whose report is over 2 s old.
        vehicle: its position, for the targets' distance; None if unknown.
        """
        for target_id in [
            i for i, t in self._targets.items() if abs(now_ns - t.time_ns) > _TARGET_AGE_NS
        ]:
            self.forget(target_id)
        told = self._reported_targets()
        for number in self._due("image", told, self._image_ns, now_ns):
            send(tracking_image_status(self._targets[number]), self._component)
        for number in self._due("geo", told, self._geo_ns, now_ns):
            message = tracking_geo_status(self._targets[number], self._geoid_m, vehicle)
            send(message, self._component)
        if self._marks is not None:
            self._capture(self._marks, now_ns, uptime_ms, send)
        if self._adsb:
            for number in self._due("adsb", list(self._targets), self._period_ns, now_ns):
                send(adsb_vehicle(self._targets[number], self._geoid_m), self._component)
        if self._targets:
            self._idle_left = _IDLE_TIMES
        elif self._idle_left > 0 and now_ns - self._idle_ns >= _IDLE_PERIOD_NS:
            self._idle_ns = now_ns
            self._idle_left -= 1
            send(tracking_image_status(None), self._component)
        if self._view is not None and now_ns - self._view_sent_ns >= self._period_ns:
            self._view_sent_ns = now_ns
            message = camera_fov_status(self._view, self._camera, self._geoid_m, uptime_ms)
            send(message, self._component)
            self._view = None

    def _capture(self, marks: Marks, now_ns: int, uptime_ms: int, send: Send) -> None:
        """Send a map marker for each target when it is confirmed."""
        mark = marks.due(self._targets, now_ns)
        if mark is not None:
            utc_us = self._utc.utc_ns(mark.report.time_ns) // 1000
            message = image_captured(mark.report, self._geoid_m, mark.index, uptime_ms, utc_us)
            send(message, self._component)

    def _reported_targets(self) -> list[int]:
        """Numbers of the targets for the camera protocol, which has room for one: the last clicked
        target; without a click all detected targets, which are reported in turn.
        """
        clicked = [number for number, target in self._targets.items() if target.clicked]
        return [max(clicked)] if clicked else list(self._targets)

    def _due(self, kind: str, numbers: list[int], period_ns: int, now_ns: int) -> list[int]:
        """Targets whose message of that kind is due, the longest waiting first; marks them sent."""
        sent = {number: self._sent_ns.get((kind, number), 0) for number in numbers}
        waited = sorted(sent, key=lambda number: sent[number])
        due = [number for number in waited if now_ns - sent[number] >= period_ns][:_PER_TICK]
        self._sent_ns.update({(kind, number): now_ns for number in due})
        return due

    def command(self, message: Any, time_ns: int, uptime_ms: int, send: Send) -> bool:
        """Execute and answer a command to the camera; False, and nothing is done, for others."""
        if message.target_component != self._component:
            return False
        result, number = self._execute(message, time_ns, uptime_ms, send), 0
        if result == mavlink.MAV_RESULT_ACCEPTED and message.command in TRACKING:
            number = self._last_click[2].number if self._last_click is not None else 0
        ack = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, number, message.get_srcSystem(), message.get_srcComponent()
        )
        send(ack, self._component)
        return True

    def _execute(self, message: Any, time_ns: int, uptime_ms: int, send: Send) -> int:
        command = message.command
        if command in TRACKING:
            return self._track(message, time_ns)
        if command in LOOKS and self._look is not None:
            return self._look.command(message)
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return self._request(message.param1, uptime_ms, send)
        if command in _OLD_REQUESTS:
            return self._request(_OLD_REQUESTS[command], uptime_ms, send)
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._interval(message.param1, message.param2)
        return int(mavlink.MAV_RESULT_UNSUPPORTED)

    def _track(self, message: Any, time_ns: int) -> int:
        request = track_request(message, time_ns)
        if request is None or self._on_track is None:
            return int(mavlink.MAV_RESULT_DENIED)
        if request.kind == "stop":
            self._last_click = None
        else:
            if self._is_repeated(message, request):
                return int(mavlink.MAV_RESULT_ACCEPTED)
            if self._pace.is_exceeded(time_ns):
                return int(mavlink.MAV_RESULT_TEMPORARILY_REJECTED)
            request = replace(request, number=next(self._numbers))
            self._last_click = (message.get_srcSystem(), message.command, request)
        self._on_track(request)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _is_repeated(self, message: Any, request: TrackRequest) -> bool:
        """Whether a station without an answer repeats a request that was accepted."""
        if self._last_click is None or not getattr(message, "confirmation", 0):
            return False
        system, command, last = self._last_click
        return (
            (system, command) == (message.get_srcSystem(), message.command)
            and last.coordinates == request.coordinates
            and request.time_ns - last.time_ns < _REPEATED_NS
        )

    def _request(self, message_id: float, uptime_ms: int, send: Send) -> int:
        answers: dict[int, Callable[[], Any]] = {
            mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: lambda: camera_information(
                self._camera, uptime_ms
            ),
            mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION: lambda: video_stream_information(
                self._camera
            ),
            mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS: lambda: tracking_image_status(
                next((self._targets[number] for number in self._reported_targets()), None)
            ),
        }
        answer = answers.get(int(message_id)) if math.isfinite(message_id) else None
        if answer is None:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        send(answer(), self._component)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _interval(self, message_id: float, interval_us: float) -> int:
        """Set the interval of a tracking message; 0: default, -1: off. Returns a MAV_RESULT."""
        if not (math.isfinite(message_id) and math.isfinite(interval_us)):
            return int(mavlink.MAV_RESULT_DENIED)
        interval = self._period_ns
        if interval_us > 0:
            interval = int(max(interval_us, _MIN_INTERVAL_US)) * 1000
        elif interval_us < 0:
            interval = 1 << 62
        if int(message_id) == mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS:
            self._image_ns = interval
        elif int(message_id) == mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_GEO_STATUS:
            self._geo_ns = interval
        else:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        return int(mavlink.MAV_RESULT_ACCEPTED)
