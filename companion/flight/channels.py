"""Channels between the components of the process.

Each component subscribes to what it needs when it is built; the sender knows none of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, ParamSpec

from companion.targets.target_manager import TargetEstimate
from localizer.types import Frame, PoseEstimate, ReferenceBundle
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.messages import TrackRequest

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
