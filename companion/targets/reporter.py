"""Computes target positions from clicks, detections and estimates, on a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import cv2

from companion.config import TargetConfig
from companion.ending import wait_for_end
from companion.targets.detections import Detection
from companion.targets.pictures import RecentPictures
from companion.targets.target_manager import Click, TargetEstimate, TargetManager
from localizer.targets.locate import RayCaster
from localizer.types import Frame, PoseEstimate
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId

_log = logging.getLogger(__name__)
_KEPT = 64  # detections that wait
_ESTIMATES = 256  # as many as `FrameTimes` knows frames: a slow detector is seconds behind
_PICTURES = 16
_MATCH_NS = 5_000_000  # detection and estimate must be of the same frame


class TargetReporter:
    """Pairs detections with accepted estimates of the same frame and updates the targets
    (`TargetManager`).

    cast: intersects rays with the map. on_target: receives each fix. on_gone: receives the name of
    each target that ended, after its last on_target. Both are called on the targets' thread.
    report_alert: sends an alert to the operator. failed: number of calls that raised an error; the
    first and each click's are logged. unmatched: number of detections whose frame has no accepted
    estimate.
    """

    def __init__(
        self,
        config: TargetConfig,
        cast: RayCaster,
        on_target: Callable[[TargetEstimate], None],
        on_gone: Callable[[str], None] = lambda _name: None,
        report_alert: Callable[[Alert], None] = lambda _alert: None,
    ) -> None:
        self._population = TargetManager(config, cast, on_target, on_gone, report_alert)
        self._on_gone, self._report_alert = on_gone, report_alert
        self._forgotten: tuple[str, ...] = ()
        self._clicks: list[Click] = []
        self._estimates: deque[PoseEstimate] = deque(maxlen=_ESTIMATES)
        self._detections: deque[Detection] = deque(maxlen=_KEPT)
        self._held: PoseEstimate | None = None
        self._pictures = RecentPictures[Frame](_PICTURES, lambda frame: frame.image.nbytes)
        self._condition = threading.Condition()
        self._stopping = False
        self.failed = self.unmatched = 0
        self._thread = threading.Thread(target=self._run, name="targets", daemon=True)

    @property
    def missed(self) -> int:
        """Number of clicks and detections whose ray does not hit the map."""
        return self._population.missed

    @property
    def doubted(self) -> int:
        """Number of detections too uncertain to be reported (`TargetTrack.refusal`)."""
        return self._population.doubted

    @property
    def refused(self) -> int:
        """Number of detections of targets beyond the 32nd."""
        return self._population.refused

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and wait for it."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        wait_for_end(self._thread)

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Add an estimate; only accepted ones are used. Never blocks."""
        if estimate.accepted:
            with self._condition:
                self._estimates.append(estimate)
                self._condition.notify()

    def add_detection(self, detection: Detection) -> None:
        """Add a detection; it waits for its frame's estimate. Never blocks."""
        with self._condition:
            self.unmatched += len(self._detections) == _KEPT  # the oldest makes room
            self._detections.append(detection)
            self._condition.notify()

    def begin(self, click: Click) -> None:
        """Start the target of a click. Never blocks."""
        with self._condition:
            self._clicks.append(click)
            self._condition.notify()

    def add_frame(self, frame: Frame) -> None:
        """Add a frame, in which clicked targets are tracked. Never blocks."""
        with self._condition:
            self._pictures.append(frame)

    def forget(self, names: tuple[str, ...]) -> None:
        """End the targets of these names and drop their waiting detections; on_gone receives those
        that were active. Never blocks.
        """
        with self._condition:
            self._forgotten += names
            kept = (d for d in self._detections if d.target_id not in names)
            self._detections = deque(kept, maxlen=_KEPT)
            self._condition.notify()

    def _run(self) -> None:
        while True:
            with self._condition:
                if not self._has_work() and not self._stopping:
                    self._condition.wait(0.5)
                if self._stopping:
                    return
                pairs = self._take_pairs()
                clicks, self._clicks = self._clicks, []
                forgotten, self._forgotten = self._forgotten, ()
                newest = self._estimates[-1] if self._estimates else None
                pictures = self._take_pictures()
            for estimate, frame in pictures:
                gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
                self._guarded(self._population.add_image, estimate, gray)
            for click in clicks:
                if not self._guarded(self._population.begin, click):
                    self._report_alert(alert(AlertId.TARGET_UNREADABLE, number=click.number))
                    self._guarded(self._population.end, (click.name,))
                    self._on_gone(click.name)
            for name in forgotten:
                self._guarded(self._population.end, (name,))
            for detection, estimate in pairs:
                if detection.target_id not in forgotten:
                    self._guarded(self._population.add_detection, detection, estimate)
            if newest is not None and newest is not self._held:
                self._held = newest
                self._guarded(self._population.predict, newest)

    def _guarded(self, work: Callable[..., None], *arguments: Any) -> bool:
        """Call `work`; False if it raised an error, which is counted."""
        try:
            work(*arguments)
        except Exception:  # a target must not end the flight
            self.failed += 1
            if self.failed == 1 or work == self._population.begin:  # an alert refers to the log
                _log.exception("a target could not be located")
            return False
        return True

    def _has_work(self) -> bool:
        newest = self._estimates[-1] if self._estimates else None
        if self._clicks or self._forgotten or newest is not self._held:
            return True
        return any(self._match(d) is not None for d in self._detections)

    def _take_pairs(self) -> list[tuple[Detection, PoseEstimate]]:
        """Take detections whose frame has an estimate; others wait until newer frames pass."""
        pairs, waiting = [], []
        newest = self._estimates[-1].exposure_time_ns if self._estimates else 0
        for detection in self._detections:
            estimate = self._match(detection)
            if estimate is not None:
                pairs.append((detection, estimate))
            elif detection.time_ns > newest - _MATCH_NS:
                waiting.append(detection)
            else:
                self.unmatched += 1
        self._detections = deque(waiting, maxlen=_KEPT)
        return pairs

    def _take_pictures(self) -> list[tuple[PoseEstimate, Frame]]:
        """Take the frames that have an estimate, and drop the older ones, which never get one."""
        found = {e.exposure_time_ns: e for e in self._estimates}
        pairs = [
            (found[f.exposure_time_ns], f) for f in self._pictures if f.exposure_time_ns in found
        ]
        newest = self._estimates[-1].exposure_time_ns if self._estimates else 0
        self._pictures.retain(lambda frame: frame.exposure_time_ns > newest)
        return pairs

    def _match(self, detection: Detection) -> PoseEstimate | None:
        for estimate in reversed(self._estimates):
            if abs(estimate.exposure_time_ns - detection.time_ns) <= _MATCH_NS:
                return estimate
            if estimate.exposure_time_ns < detection.time_ns:
                return None  # older ones are farther from it
        return None
