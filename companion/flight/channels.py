"""Channels between the components of the process, and the thread that sends the camera's frames.

Each component subscribes to what it needs when it is built; the sender knows none of them.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, ParamSpec

from companion.ending import wait_for_end
from companion.sources import FrameSource
from companion.targets.target_manager import TargetEstimate
from localizer.types import Frame, PoseEstimate, ReferenceBundle
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.messages import TrackRequest

_log = logging.getLogger(__name__)

P = ParamSpec("P")


class Channel(Generic[P]):
    """Calls every subscriber with each sent value, on the sender's thread, in the order of
    subscription. Subscribers must return at once, for example after queueing the value.
    """

    def __init__(self) -> None:
        self._subscribers: tuple[Callable[P, None], ...] = ()

    def subscribe(self, take: Callable[P, None]) -> None:
        """Call `take` with every value that is sent from now on."""
        self._subscribers = (*self._subscribers, take)

    def send(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Call every subscriber; raise the first of their errors when all were called."""
        failed: Exception | None = None
        for take in self._subscribers:
            try:
                take(*args, **kwargs)
            except Exception as error:  # one part's fault must not starve the others
                failed = failed or error
        if failed is not None:
            raise failed


@dataclass(frozen=True)
class Channels:
    """Every channel of one process, each with the thread that sends on it."""

    frames: Channel[[Frame]] = field(default_factory=Channel)
    """Every frame of the camera, on the feed's thread."""
    estimates: Channel[[PoseEstimate, ReferenceBundle]] = field(default_factory=Channel)
    """Every estimate, accepted or not, with its reference view, on the localization thread."""
    targets: Channel[[TargetEstimate]] = field(default_factory=Channel)
    """Every located target, on the targets' thread."""
    gone: Channel[[str]] = field(default_factory=Channel)
    """The name of every target that ended, on the targets' thread."""
    clicks: Channel[[TrackRequest]] = field(default_factory=Channel)
    """What the ground station asks the camera to track, on a MAVLink link's thread."""
    alerts: Channel[[Alert]] = field(default_factory=Channel)
    """Every alert that the operator was told, on any thread."""
    events: Channel[[str, str]] = field(default_factory=Channel)
    """What happens (level, text) and is told nobody in flight: for log and record, any thread."""


class Feed:
    """Passes every frame of a source to `take`, on its own thread. ended: set when the source ends;
    error: what ended it, None for a normal end. failures: number of frames for which `take` raised;
    the flight continues.
    """

    def __init__(self, source: FrameSource, take: Callable[[Frame], None]) -> None:
        self._source = source
        self._take = take
        self.ended = threading.Event()
        self.error: Exception | None = None
        self.failures = 0
        self._taken_ns: int | None = None
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Close the source and wait for the thread."""
        self._source.close()
        wait_for_end(self._thread)

    @property
    def last_tick_ns(self) -> int:
        """When the present frame came, CLOCK_MONOTONIC; now while waiting for a frame."""
        taken_ns = self._taken_ns
        return time.monotonic_ns() if taken_ns is None else taken_ns

    def _run(self) -> None:
        try:
            for frame in self._source.frames():
                self._taken_ns = time.monotonic_ns()
                self._pass_on(frame)
                self._taken_ns = None
        except Exception as error:
            self.error = error
        self.ended.set()

    def _pass_on(self, frame: Frame) -> None:
        try:
            self._take(frame)
        except Exception:  # a part's fault, which the others and the next frames do not share
            self.failures += 1
            if self.failures in (1, 10, 100, 1000):
                _log.exception("a part failed on a frame (%d times)", self.failures)
