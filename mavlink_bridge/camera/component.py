"""The camera component at work on one link: answers its commands, streams its status.

Commands must be addressed to the camera component itself; ArduPilot does not pass tracking commands
that are addressed to the autopilot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.camera.messages import (
    camera_fov_status,
    camera_information,
    track_request,
    video_stream_information,
)
from mavlink_bridge.camera.targets import (
    adsb_vehicle,
    tracking_geo_status,
    tracking_image_status,
)
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import CameraView, Origin, TargetReport, TrackRequest

Send = Callable[[Any, int], bool]
_TARGET_AGE_NS = 2_000_000_000
_IDLE_PERIOD_NS = 1_000_000_000
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
_MIN_INTERVAL_US = 20_000
_PER_TICK = 4  # targets: more in one go would fill a slow port, and positions wait behind them


class CameraComponent:
    """One link's view of the camera. All methods run in that link's owner thread."""

    def __init__(
        self,
        config: BridgeConfig,
        geoid_separation_m: float,
        on_track: Callable[[TrackRequest], None] | None,
        *,
        ground_link: bool,
    ) -> None:
        self._camera = config.camera
        self._component = config.camera_component
        self._adsb = config.targets.adsb and ground_link
        self._geoid_m = geoid_separation_m
        self._on_track = on_track
        self._period_ns = int(1e9 / config.targets.rate_hz)
        self._image_ns = self._geo_ns = self._period_ns
        self._targets: dict[int, TargetReport] = {}
        self._sent_ns: dict[int, int] = {}
        self._view: CameraView | None = None
        self._view_sent_ns = 0
        self._idle_ns = 0

    @property
    def targets(self) -> int:
        """How many targets are reported on."""
        return len(self._targets)

    def report(self, target: TargetReport) -> None:
        """The newest fix of a target."""
        self._targets[target.target_id] = target

    def forget(self, target_id: int) -> None:
        """Report on that target no more."""
        self._targets.pop(target_id, None)
        self._sent_ns.pop(target_id, None)

    def look(self, view: CameraView) -> None:
        """The newest camera pose."""
        self._view = view

    def tick(self, now_ns: int, vehicle: Origin | None, uptime_ms: int, send: Send) -> None:
        """Send what is due."""
        for target_id in [
            i for i, t in self._targets.items() if abs(now_ns - t.time_ns) > _TARGET_AGE_NS
        ]:
            del self._targets[target_id]
            self._sent_ns.pop(target_id, None)
        sent = {target_id: self._sent_ns.get(target_id, 0) for target_id in self._targets}
        due = [i for i, t in sent.items() if now_ns - t >= min(self._geo_ns, self._image_ns)]
        for target_id in sorted(due, key=lambda i: sent[i])[:_PER_TICK]:
            self._sent_ns[target_id] = now_ns
            self._send_target(self._targets[target_id], vehicle, send)
        if not self._targets and now_ns - self._idle_ns >= _IDLE_PERIOD_NS:
            self._idle_ns = now_ns
            send(tracking_image_status(None), self._component)
        if self._view is not None and now_ns - self._view_sent_ns >= self._period_ns:
            self._view_sent_ns = now_ns
            message = camera_fov_status(self._view, self._camera, self._geoid_m, uptime_ms)
            send(message, self._component)
            self._view = None

    def _send_target(self, target: TargetReport, vehicle: Origin | None, send: Send) -> None:
        send(tracking_geo_status(target, self._geoid_m, vehicle), self._component)
        send(tracking_image_status(target), self._component)
        if self._adsb:
            send(adsb_vehicle(target, self._geoid_m), self._component)

    def command(self, message: Any, time_ns: int, uptime_ms: int, send: Send) -> bool:
        """Answer a COMMAND_LONG to the camera; False when it is not for it."""
        if message.target_component != self._component:
            return False
        result = self._execute(message, time_ns, uptime_ms, send)
        ack = mavlink.MAVLink_command_ack_message(
            message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
        )
        send(ack, self._component)
        return True

    def _execute(self, message: Any, time_ns: int, uptime_ms: int, send: Send) -> int:
        command = message.command
        if command in TRACKING:
            request = track_request(message, time_ns)
            if request is None or self._on_track is None:
                return int(mavlink.MAV_RESULT_DENIED)
            self._on_track(request)
            return int(mavlink.MAV_RESULT_ACCEPTED)
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return self._request(message.param1, uptime_ms, send)
        if command in _OLD_REQUESTS:
            return self._request(_OLD_REQUESTS[command], uptime_ms, send)
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._interval(message.param1, message.param2)
        return int(mavlink.MAV_RESULT_UNSUPPORTED)

    def _request(self, message_id: float, uptime_ms: int, send: Send) -> int:
        answers: dict[int, Callable[[], Any]] = {
            mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION: lambda: camera_information(
                self._camera, uptime_ms
            ),
            mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION: lambda: video_stream_information(
                self._camera
            ),
            mavlink.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS: lambda: tracking_image_status(
                next(iter(self._targets.values()), None)
            ),
        }
        answer = answers.get(int(message_id)) if math.isfinite(message_id) else None
        if answer is None:
            return int(mavlink.MAV_RESULT_UNSUPPORTED)
        send(answer(), self._component)
        return int(mavlink.MAV_RESULT_ACCEPTED)

    def _interval(self, message_id: float, interval_us: float) -> int:
        """SET_MESSAGE_INTERVAL of the tracking messages; 0 is the default rate, -1 is off."""
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
