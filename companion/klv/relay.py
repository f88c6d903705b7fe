"""Forwards the camera's video unchanged, with ST 0601 metadata of its frames.

A packet waits for its frame's pose, at most `hold_ms`. A frame without a pose by then is forwarded
without metadata.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeVar

import av

from companion.config import KlvConfig
from companion.ending import wait_for_end
from companion.errors import StreamError
from companion.klv.local_set import encode
from companion.klv.metadata import KlvContext, frame_fields
from companion.klv.transport import TransportWriter
from companion.targets.target_manager import TargetEstimate
from localizer.geometry.pose import Array
from localizer.types import PoseEstimate, TargetFix

_log = logging.getLogger(__name__)
_Key = TypeVar("_Key")
_Value = TypeVar("_Value")
_QUEUE = 512  # packets: seconds of video
_KEPT = 64  # exposures, estimates, targets
_TARGET_NS = 1_000_000_000  # a target that was seen so near to a picture is the picture's


@dataclass(frozen=True)
class _RelayItem:
    """A packet, or a new connection's writer; arrival_ns: CLOCK_MONOTONIC."""

    arrival_ns: int
    packet: av.Packet | None = None
    writer: TransportWriter | None = None


class KlvRelay:
    """A `PacketTap` that writes to `config.output` on its own thread.

    attitude: gives the aircraft's attitude at a time, NED from body (3, 3); None if unknown.
    utc_minus_monotonic_ns: difference of this computer's clocks. Failures are counted; the first
    one is reported.
    """

    def __init__(
        self,
        config: KlvConfig,
        scene: KlvContext,
        attitude: Callable[[int], Array | None],
        utc_minus_monotonic_ns: int,
    ) -> None:
        self._config = config
        self._scene = scene
        self._attitude = attitude
        self._utc_ns = utc_minus_monotonic_ns
        self._items: deque[_RelayItem] = deque()
        self._exposures: dict[Fraction, int] = {}
        self._estimates: dict[int, PoseEstimate] = {}
        self._newest_ns = 0
        self._targets: dict[int, TargetEstimate] = {}
        self._writer: TransportWriter | None = None
        self._condition = threading.Condition()
        self._stopping = False
        self.sent = self.described = self.dropped = self.failed = 0
        self._thread = threading.Thread(target=self._run, name="klv", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and end the stream; packets that wait are dropped."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        wait_for_end(self._thread)

    def begin(self, stream: av.VideoStream) -> None:
        """Begin a new stream for the packets after this call. If that fails, it is counted, and
        they go on into the stream before.
        """
        try:
            writer = TransportWriter(self._config.output, stream)
        except StreamError as error:
            self._fail(error)
            return
        self._put(_RelayItem(time.monotonic_ns(), writer=writer))

    def packet(self, packet: av.Packet) -> None:
        """Queue a packet; it is dropped and counted if 512 wait. Never blocks."""
        self._put(_RelayItem(time.monotonic_ns(), packet=packet))

    def frame_exposed(self, pts: Fraction, exposure_time_ns: int) -> None:
        """Store the exposure time of the frame with that presentation time (s). Never blocks."""
        with self._condition:
            _keep(self._exposures, pts, exposure_time_ns)

    def add_estimate(self, estimate: PoseEstimate) -> None:
        """Take every estimate. An accepted one's pose is stored; a rejected or later one ends the
        wait of earlier frames, which go without metadata. Never blocks.
        """
        with self._condition:
            self._newest_ns = max(self._newest_ns, estimate.exposure_time_ns)
            if estimate.accepted:
                _keep(self._estimates, estimate.exposure_time_ns, estimate)
            self._condition.notify()

    def add_target(self, target: TargetEstimate) -> None:
        """Store a target's fix, for the metadata of frames within 1 s of it. Never blocks."""
        with self._condition:
            _keep(self._targets, target.fix.exposure_time_ns, target)

    def _put(self, item: _RelayItem) -> None:
        with self._condition:
            if len(self._items) >= _QUEUE and item.packet is not None:
                self.dropped += 1
                return
            self._items.append(item)
            self._condition.notify()

    def _run(self) -> None:
        while True:
            with self._condition:
                while not self._items and not self._stopping:
                    self._condition.wait()
                if self._stopping:
                    break
                item = self._items.popleft()
                estimate = self._wait_for(item)
            try:
                self._send(item, estimate)
            except Exception as error:  # a lost stream must not end the flight
                self._fail(error)
        self._close()

    def _wait_for(self, item: _RelayItem) -> PoseEstimate | None:
        """The estimate of a packet's frame; None if there is none in time. The caller holds the
        lock.
        """
        if item.packet is None or item.packet.pts is None:
            return None
        pts = Fraction(item.packet.pts * item.packet.time_base)
        until_ns = item.arrival_ns + round(self._config.hold_ms * 1e6)
        while not self._stopping:
            exposure_ns = self._exposures.get(pts)
            if exposure_ns is not None and self._newest_ns >= exposure_ns:
                return self._estimates.get(exposure_ns)  # newer ones come no more for it
            left_ns = until_ns - time.monotonic_ns()
            if left_ns <= 0:
                return None
            self._condition.wait(left_ns * 1e-9)
        return None

    def _send(self, item: _RelayItem, estimate: PoseEstimate | None) -> None:
        if item.writer is not None:
            self._close()
            self._writer = item.writer
        if item.packet is None or self._writer is None:
            return
        if estimate is not None:
            pts = Fraction(item.packet.pts * item.packet.time_base)
            self._writer.describe(pts, self._metadata(estimate))
            self.described += 1
        self._writer.write(item.packet)
        self.sent += 1

    def _metadata(self, estimate: PoseEstimate) -> bytes:
        time_ns = estimate.exposure_time_ns
        fields = frame_fields(
            estimate, self._scene, self._attitude(time_ns), self._target_at(time_ns)
        )
        return encode((time_ns + self._utc_ns) // 1000, fields)

    def _target_at(self, time_ns: int) -> TargetFix | None:
        """The target's fix nearest to a frame's time. Newer ones may exist, because the frame may
        have waited for its pose.
        """
        with self._condition:
            seen_ns = min(self._targets, key=lambda t: abs(t - time_ns), default=None)
            if seen_ns is None or abs(seen_ns - time_ns) > _TARGET_NS:
                return None
            return self._targets[seen_ns].fix

    def _close(self) -> None:
        if self._writer is not None:
            try:
                self._writer.close()
            except OSError as error:
                self._fail(error)
            self._writer = None

    def _fail(self, error: Exception) -> None:
        self.failed += 1
        if self.failed == 1:
            _log.warning("klv.output %s: %s", self._config.output, error)


def _keep(of: dict[_Key, _Value], key: _Key, value: _Value) -> None:
    """Store a value, and drop the oldest of more than 64."""
    of[key] = value
    if len(of) > _KEPT:
        del of[next(iter(of))]
