"""Detections and estimates of the same frame become target coordinates, on a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from companion.config import TargetConfig
from companion.targets.detections import Detection
from localizer.geometry.pose import Array
from localizer.targets.filter import TargetFilter
from localizer.targets.locate import RayCaster, locate
from localizer.types import PoseEstimate, TargetFix, TargetSighting

_log = logging.getLogger(__name__)
_KEPT = 64
_MATCH_NS = 5_000_000  # detection and estimate must be of the same frame
_MAX_TARGETS = 32  # at a time: what a telemetry link bears
# A target unseen for so long makes room for another.
_GONE_NS = 10_000_000_000


@dataclass(frozen=True)
class Target:
    """A filtered fix. velocity: (3,) m/s, world axes; None of what was located once."""

    fix: TargetFix
    velocity: Array | None
    estimate: PoseEstimate


class TargetReporter:
    """Pairs detections with accepted estimates, casts the rays, filters, and hands the target on.

    on_gone: called on the targets' thread with each name that `forget` ended, after the last
    on_target of that name.
    missed counts detections that show no map: beside the picture, or in the sky; failed what
    raised an error, of which the first is logged; refused those of targets beyond the 32nd.
    """

    def __init__(
        self,
        config: TargetConfig,
        cast: RayCaster,
        on_target: Callable[[Target], None],
        on_gone: Callable[[str], None] = lambda _name: None,
    ) -> None:
        self._config = config
        self._cast = cast
        self._on_target = on_target
        self._on_gone = on_gone
        self._forgotten: tuple[str, ...] = ()
        self._estimates: deque[PoseEstimate] = deque(maxlen=_KEPT)
        self._detections: deque[Detection] = deque(maxlen=_KEPT)
        self._filters: dict[str, TargetFilter] = {}
        self._reported_ns: dict[str, int] = {}
        self._condition = threading.Condition()
        self._stopping = False
        self.missed = 0
        self.failed = 0
        self.refused = 0
        self._thread = threading.Thread(target=self._run, name="targets")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._thread.join()

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Offer an estimate; only accepted ones are used. Never blocks."""
        if estimate.accepted:
            with self._condition:
                self._estimates.append(estimate)
                self._condition.notify()

    def add_detection(self, detection: Detection) -> None:
        """Offer a detection; it waits for its frame's estimate. Never blocks."""
        with self._condition:
            self._detections.append(detection)
            self._condition.notify()

    def forget(self, names: tuple[str, ...]) -> None:
        """End these targets: what was seen of them is dropped. Never blocks."""
        with self._condition:
            self._forgotten += names
            kept = (d for d in self._detections if d.target_id not in names)
            self._detections = deque(kept, maxlen=_KEPT)
            self._condition.notify()

    def _run(self) -> None:
        while True:
            with self._condition:
                pairs = self._take_pairs()
                if not pairs and not self._forgotten and not self._stopping:
                    self._condition.wait(0.5)
                    pairs = self._take_pairs()
                if self._stopping:
                    return
                forgotten, self._forgotten = self._forgotten, ()
            self._end(forgotten)
            for detection, estimate in pairs:
                if detection.target_id in forgotten:
                    continue
                try:
                    self._locate(detection, estimate)
                except Exception:  # a target must not end the flight
                    self.failed += 1
                    if self.failed == 1:
                        _log.exception("target %s could not be located", detection.target_id)

    def _end(self, names: tuple[str, ...]) -> None:
        for name in names:
            self._filters.pop(name, None)
            if self._reported_ns.pop(name, None) is None:
                continue
            try:
                self._on_gone(name)
            except Exception:
                _log.exception("the end of target %s could not be told", name)

    def _take_pairs(self) -> list[tuple[Detection, PoseEstimate]]:
        """Detections whose frame has an estimate; the rest wait until newer frames pass them."""
        pairs, waiting = [], []
        newest = self._estimates[-1].exposure_time_ns if self._estimates else 0
        for detection in self._detections:
            estimate = self._match(detection)
            if estimate is not None:
                pairs.append((detection, estimate))
            elif detection.time_ns > newest - _MATCH_NS:
                waiting.append(detection)
        self._detections = deque(waiting, maxlen=_KEPT)
        return pairs

    def _match(self, detection: Detection) -> PoseEstimate | None:
        for estimate in reversed(self._estimates):
            if abs(estimate.exposure_time_ns - detection.time_ns) <= _MATCH_NS:
                return estimate
        return None

    def _locate(self, detection: Detection, estimate: PoseEstimate) -> None:
        last = self._reported_ns.get(detection.target_id)
        wait_ns = 0.9e9 / self._config.rate_hz  # frames do not fall on the period exactly
        if last is not None and estimate.exposure_time_ns - last < wait_ns:
            return
        if last is None and not self._has_room(estimate.exposure_time_ns):
            return  # before the work: a flood of names must cost next to nothing
        pixel = (detection.u, detection.v)
        sigmas = self._config.pixel_sigma, self._config.map_sigma_m
        inside = 0 <= pixel[0] <= estimate.camera.width and 0 <= pixel[1] <= estimate.camera.height
        surfaces = locate(estimate, pixel, self._cast, *sigmas) if inside else ()
        if not surfaces:
            self.missed += 1
            return
        time_ns = estimate.exposure_time_ns
        self._reported_ns[detection.target_id] = time_ns
        target_filter = self._filters.setdefault(detection.target_id, TargetFilter())
        fix = target_filter.update(TargetSighting(detection.target_id, surfaces, pixel, time_ns))
        self._on_target(Target(fix, target_filter.velocity, estimate))

    def _has_room(self, now_ns: int) -> bool:
        """Whether one more target can be followed, once those that are gone are forgotten."""
        if len(self._reported_ns) < _MAX_TARGETS:
            return True
        for name in [n for n, t in self._reported_ns.items() if now_ns - t > _GONE_NS]:
            del self._reported_ns[name], self._filters[name]
        if len(self._reported_ns) < _MAX_TARGETS:
            return True
        self.refused += 1
        if self.refused == 1:
            _log.warning("more than %d targets at a time: the newest are left out", _MAX_TARGETS)
        return False
