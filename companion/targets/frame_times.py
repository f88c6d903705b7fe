"""Finds the exposure time of a frame that a detector names by number or presentation time."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

import av

from companion.targets.detections import Detection, FrameName
from localizer.types import Frame

_KEPT = 256  # frames: as many as a slow detector may be behind
_WAITING = 64
_SAME_S = 0.001  # presentation times that differ by less are of one picture


class FrameTimes:
    """Gives each detection its frame's exposure time, at once or when the frame arrives.

    As a `PacketTap` it learns the frames' presentation times. on_detection: receives detections
    with a time; must not block. unmatched: number of detections whose frame never arrived.
    Thread-safe.
    """

    def __init__(self, on_detection: Callable[[Detection], None]) -> None:
        self._on_detection = on_detection
        self._by_sequence: OrderedDict[int, int] = OrderedDict()
        self._by_pts: OrderedDict[Fraction, int] = OrderedDict()
        self._waiting: deque[tuple[Detection, FrameName]] = deque()
        self._lock = threading.Lock()
        self.unmatched = 0

    def add_detection(self, detection: Detection, name: FrameName | None = None) -> None:
        """Pass a detection on, in the caller's thread. With a frame name it waits for the frame's
        exposure time; of more than 64 that wait, the oldest is dropped and counted.
        """
        if name is None:
            self._on_detection(detection)
            return
        with self._lock:
            time_ns = self._time_of(name)
            if time_ns is None:
                self._waiting.append((detection, name))
                if len(self._waiting) > _WAITING:
                    self._waiting.popleft()
                    self.unmatched += 1
                return
        self._on_detection(replace(detection, time_ns=time_ns))

    def add_frame(self, frame: Frame) -> None:
        """Store a frame's number and exposure time, and pass on what waits for it. Never blocks."""
        with self._lock:
            self._by_sequence[frame.sequence] = frame.exposure_time_ns
            if len(self._by_sequence) > _KEPT:
                self._by_sequence.popitem(last=False)
        self._release()

    def begin(self, stream: av.VideoStream) -> None:
        """Note that a new connection restarts the presentation times. Detections that still wait
        for a frame by its presentation time are dropped and counted as unmatched.
        """
        with self._lock:
            self._by_pts.clear()
            kept = deque((d, n) for d, n in self._waiting if n.pts_s is None)
            self.unmatched += len(self._waiting) - len(kept)
            self._waiting = kept

    def packet(self, packet: av.Packet) -> None:
        """Does nothing; part of `PacketTap`."""

    def frame_exposed(self, pts: Fraction, exposure_time_ns: int) -> None:
        """Store a frame's presentation time (s) and exposure time (CLOCK_MONOTONIC). Pass on the
        detections that waited for it, in the caller's thread.
        """
        with self._lock:
            self._by_pts[pts] = exposure_time_ns
            if len(self._by_pts) > _KEPT:
                self._by_pts.popitem(last=False)
        self._release()

    def _release(self) -> None:
        """Pass on the detections whose frame has arrived."""
        with self._lock:
            timed = [(d, n, self._time_of(n)) for d, n in self._waiting]
            self._waiting = deque((d, n) for d, n, t in timed if t is None)
        for detection, _, time_ns in timed:
            if time_ns is not None:
                self._on_detection(replace(detection, time_ns=time_ns))

    def _time_of(self, name: FrameName) -> int | None:
        if name.sequence is not None:
            return self._by_sequence.get(name.sequence)
        for pts in reversed(self._by_pts):
            if name.pts_s is not None and abs(float(pts) - name.pts_s) < _SAME_S:
                return self._by_pts[pts]
        return None
