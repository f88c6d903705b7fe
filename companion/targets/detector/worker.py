"""Runs the detector on at most `rate_hz` frames a second, on its own thread.

It processes a frame only if its pose is known, one at a time, and pauses after each, to limit its
share of one processor. Errors are counted and reported once.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from companion.config import DetectorConfig
from companion.ending import wait_for_end
from companion.targets.detections import DETECTED, Detection
from companion.targets.detector.boxes import Box
from companion.targets.detector.names import LocatedBox, ObjectNames
from companion.targets.detector.network import DetectorNetwork
from companion.targets.pictures import RecentPictures
from localizer.targets.locate import RayCaster, ray_in_world
from localizer.types import Frame, PoseEstimate
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId

_log = logging.getLogger(__name__)
_KEPT = 16  # pictures and estimates
_MATCH_NS = 5_000_000
_FAILURES = 3  # in a row: it is given up
_MOST_AWAY_M = 5000.0


class BoxDetector:
    """Detects objects in the camera's frames and passes them on as detections.

    cast: intersects rays with the map. on_detection: receives each detection; must not block.
    report: sends an alert to the operator. A model that cannot be loaded, or fails three times in a
    row, ends the detector; the flight continues. looked, seen, failed: numbers of frames, boxes and
    errors.
    """

    def __init__(
        self,
        config: DetectorConfig,
        cast: RayCaster,
        on_detection: Callable[[Detection], None],
        report: Callable[[Alert], None],
        load: Callable[[DetectorConfig], DetectorNetwork] = DetectorNetwork,
    ) -> None:
        self._config, self._cast = config, cast
        self._on_detection, self._report, self._load = on_detection, report, load
        self._names = ObjectNames()
        self._frames = RecentPictures[Frame](_KEPT, lambda frame: frame.image.nbytes)
        self._estimates: deque[PoseEstimate] = deque(maxlen=_KEPT)
        self._condition = threading.Condition()
        self._stopping = threading.Event()
        self._looked_ns = 0
        self._in_a_row = 0
        self.looked = self.seen = self.failed = 0
        self.is_working = False
        self._thread = threading.Thread(target=self._run, name="detector", daemon=True)

    def start(self) -> None:
        """Start the thread, which loads the model."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread after the present frame."""
        self._stopping.set()
        with self._condition:
            self._condition.notify()
        wait_for_end(self._thread)

    def add_frame(self, frame: Frame) -> None:
        """Keep a frame until its estimate arrives. Never blocks."""
        with self._condition:
            self._frames.append(frame)

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Add a frame's pose; only accepted ones are used. Never blocks."""
        if estimate.accepted:
            with self._condition:
                self._estimates.append(estimate)
                self._condition.notify()

    def _run(self) -> None:
        try:
            network = self._load(self._config)
        except Exception as error:  # the flight goes on without it
            self._give_up(str(error))
            return
        self.is_working = True
        while not self._stopping.is_set():
            pair = self._newest_pair()
            if pair is None:
                continue
            begun = time.monotonic()
            try:
                self._process(network, *pair)
                self._in_a_row = 0
            except Exception as error:
                self.failed += 1
                self._in_a_row += 1
                if self.failed == 1:
                    _log.exception("the detector failed")
                if self._in_a_row >= _FAILURES:
                    self._give_up(f"{type(error).__name__}: {error}")
                    return
            took_s = time.monotonic() - begun
            rest_s = max(1.0 / self._config.rate_hz - took_s, took_s * (1 / self._config.duty - 1))
            self._stopping.wait(rest_s)
        self.is_working = False

    def _give_up(self, why: str) -> None:
        self.is_working = False
        self.failed += 1
        _log.warning("the detector is off: %s", why)
        self._report(alert(AlertId.DETECTOR_OFF))

    def _newest_pair(self) -> tuple[Frame, PoseEstimate] | None:
        """Newest unprocessed frame with its pose; None after waiting half a second."""
        with self._condition:
            pair = self._pair()
            if pair is None:
                self._condition.wait(0.5)
                pair = self._pair()
        return pair

    def _pair(self) -> tuple[Frame, PoseEstimate] | None:
        for estimate in reversed(self._estimates):
            if estimate.exposure_time_ns <= self._looked_ns:
                return None
            for frame in self._frames:
                if abs(frame.exposure_time_ns - estimate.exposure_time_ns) <= _MATCH_NS:
                    return frame, estimate
        return None

    def _process(self, network: DetectorNetwork, frame: Frame, estimate: PoseEstimate) -> None:
        self._looked_ns = estimate.exposure_time_ns
        boxes = network.detect(frame.image)
        self.looked += 1
        placed = [
            (box, place) for box in boxes if (place := self._locate(box, estimate)) is not None
        ]
        sights = [LocatedBox(network.name_of(box.label), place) for box, place in placed]
        names = self._names.name(sights, estimate.exposure_time_ns)
        for (box, _), name in zip(placed, names, strict=True):
            if name is not None:
                self.seen += 1
                u, v = _middle(box)
                told = Detection(f"{DETECTED}{name}", estimate.exposure_time_ns, u, v)
                self._on_detection(told)

    def _locate(self, box: Box, estimate: PoseEstimate) -> np.ndarray | None:
        u, v = _middle(box)
        if not (0.0 <= u <= estimate.camera.width and 0.0 <= v <= estimate.camera.height):
            return None
        eye, direction = ray_in_world(estimate, (u, v))
        distance = float(self._cast(eye, direction[None]).distances[0])
        if not distance <= _MOST_AWAY_M:
            return None
        place: np.ndarray = eye + distance * direction
        return place


def _middle(box: Box) -> tuple[float, float]:
    return 0.5 * (box.left + box.right), 0.5 * (box.top + box.bottom)
