"""Localizes a recorded flight again with the same frames and MAVLink.

It uses no threads, so the result does not depend on the machine's speed. Each frame that was
localized in flight is localized again, with the telemetry that had arrived by then.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from companion.conversions import CameraExtrinsics
from companion.errors import RecordError, StreamDecodeError
from companion.flight.priors import AutopilotPose
from companion.offline.record import MIN_IMAGES, FlightRecord, RecordedEstimate
from companion.recorded.flight import LogBeside, RecordedFrame
from companion.sources.zoom import ZoomTable, with_focal_factor
from localizer.errors import OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array
from localizer.tracking.opening import MapStack, build_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import PoseEstimate
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.tlog import read_tlog
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.tracker import VehicleTracker


class RecordedAutopilot(VehicleTracker):
    """The vehicle's telemetry from a record's messages, replayed to any later time: call `advance`
    before each look. start_ns: messages before it, CLOCK_MONOTONIC, are left out. `TlogError` if
    the log cannot be read.
    """

    def __init__(self, bridge: BridgeConfig, log: LogBeside, start_ns: int) -> None:
        super().__init__(bridge)
        self._now_ns = start_ns
        dated = ((utc - log.ahead_ns, m) for utc, m in read_tlog(log.path))
        # A .tlog is appended to: earlier flights may stand before this one.
        self._messages = (item for item in dated if item[0] >= start_ns)
        self._next = next(self._messages, None)

    def advance(self, time_ns: int) -> None:
        """Process all messages that had arrived by `time_ns`, CLOCK_MONOTONIC."""
        self._now_ns = time_ns
        while self._next is not None and self._next[0] <= time_ns:
            received_ns, message = self._next
            if self.accepts(message):
                if message.get_type() != "TIMESYNC":
                    self.handle(message, received_ns)
                elif message.tc1 != 0:  # an answer; ts1 is our own time of the question
                    self.timesync(message.tc1, message.ts1, received_ns)
            self._next = next(self._messages, None)

    def zoom_factor(self, zoom: ZoomTable | None, time_ns: int) -> float | None:
        """Multiple of the model's focal length by the log; 1 if the camera has no zoom, None if the
        log has no value.
        """
        if zoom is None:
            return 1.0
        level = self.zoom_at(time_ns, zoom.hold_s)
        return None if level is None else zoom.factor(level)

    def state(self) -> VehicleState:
        """The vehicle's state at the current replay time."""
        return self.snapshot(self._now_ns)


_log = logging.getLogger(__name__)
_ALIKE = 1e-3  # a share of the focal length that is no other lens


@dataclass(frozen=True)
class ReplayedFrame:
    """Results of one frame. replayed: None without a prior or outside the map."""

    recorded: RecordedEstimate
    replayed: PoseEstimate | None


@dataclass(frozen=True)
class ReplaySummary:
    """Comparison of record and replay. Differences are of frames accepted both times."""

    frames: int
    accepted_recorded: int
    accepted_replayed: int
    accepted_both: int
    translation_m: Array
    rotation_deg: Array

    def agrees(self, tolerance_m: float) -> bool:
        """Whether 95 % of the frames that were accepted in flight are accepted again, and the 95th
        percentile of their position difference is at most `tolerance_m`. If none was accepted in
        flight, none may be accepted now.
        """
        if self.accepted_recorded == 0:
            return self.accepted_replayed == 0
        if self.accepted_both < 0.95 * self.accepted_recorded:
            return False
        return bool(np.percentile(self.translation_m, 95) <= tolerance_m)


def replay(
    record: FlightRecord, progress: Callable[[], None] = lambda: None
) -> list[ReplayedFrame]:
    """Localize the recorded frames again, over the map and with the settings of the record; frames
    without an image are left out. progress: called before each frame.
    `RecordError` if too few images can be read, or the map's origin is not the flight's.
    """
    config = record.config
    autopilot = RecordedAutopilot(config.bridge, record.log, record.tables.start_ns)
    stack = MapStack(config.map, config.localizer)
    try:
        camera = config.camera.model.camera()
        cache = stack.cache
        record.tables.flown_map.require_frame(cache)
        arm = np.array(config.camera.lever_arm_m)
        extrinsics = CameraExtrinsics(cache.frame, cache.manifest.geoid_separation_m, arm)
        pose = AutopilotPose(autopilot, extrinsics)
        localizer = build_localizer(stack, camera, config.localizer, pose.sensors)
        frames, unzoomed = [], 0
        for one, recorded in zip(record.flight.frames, record.estimates, strict=True):
            progress()
            if not one.path.is_file():
                continue
            autopilot.advance(recorded.known_ns)
            if localizer.tracker.track_status.wants_prior:
                prior = pose.prior(recorded.exposure_time_ns)
                if prior is not None:
                    localizer.offer(prior)
            factor: float | None = 1.0
            if recorded.focal_px is None:  # as in older records
                factor = autopilot.zoom_factor(config.camera.zoom, recorded.exposure_time_ns)
            if factor is None:  # a fix of it would be metres off and look as good as any
                unzoomed += 1
                frames.append(ReplayedFrame(recorded, None))
                continue
            try:
                again = _localize(localizer, with_focal_factor(camera, factor), recorded, one)
            except StreamDecodeError as error:  # power may have gone while it was written
                _log.warning("left out: %s", error)
                continue
            if again is not None and again.accepted:
                pose.belief.note_fix(again.exposure_time_ns)
            frames.append(ReplayedFrame(recorded, again))
        if unzoomed:
            _log.warning(
                "%d of %d frames are not localized again: neither estimates.csv nor %s tells "
                "the zoom that they were taken with", unzoomed,
                len(record.estimates), record.log.path,
            )  # fmt: skip
        if len(frames) < MIN_IMAGES * len(record.estimates):
            raise RecordError(
                f"{record.folder}: only {len(frames)} of {len(record.estimates)} images in "
                "snapshots can be read; nothing can be said about this flight"
            )
        return frames
    finally:
        stack.close()


def _localize(
    localizer: Localizer, camera: Camera, recorded: RecordedEstimate, one: RecordedFrame
) -> PoseEstimate | None:
    frame = one.load(camera, recorded.exposure_time_ns, recorded.sequence)
    if recorded.focal_px is not None:
        factor = recorded.focal_px / frame.camera.fx
        if abs(factor - 1.0) > _ALIKE:
            frame = replace(frame, camera=with_focal_factor(frame.camera, factor))
    try:
        return localizer.track(frame)
    except OutsideMapError:
        return None


def summarize(frames: list[ReplayedFrame]) -> ReplaySummary:
    """Compare the recorded and the replayed result of every frame: counts of accepted frames, and
    distances (m, degrees) where both are accepted.
    """
    again = [f.replayed is not None and f.replayed.accepted for f in frames]
    differences = [
        f.recorded.world_from_camera.distance_to(f.replayed.world_from_camera)
        for f in frames
        if f.replayed is not None and f.replayed.accepted and f.recorded.accepted
    ]
    values = np.array(differences).reshape(-1, 2)
    return ReplaySummary(
        len(frames), sum(f.recorded.accepted for f in frames), sum(again), len(values),
        values[:, 0], values[:, 1],
    )  # fmt: skip
