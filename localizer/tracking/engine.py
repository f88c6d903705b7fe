"""The dual-thread engine (paper, Sec. 3.2): rendering runs beside localization.

The localization thread takes the newest frame, registers it against the newest reference and
publishes the estimate. Each estimate wakes the render thread, which predicts the pose at the next
exposure, renders the reference for it and has the map loaded along the way ahead. Neither waits for
a subscriber, and neither dies of an error: errors are counted, logged and reported as the engine's
health.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from localizer.errors import LocalizerError
from localizer.tracking.mailbox import Mailbox
from localizer.tracking.pipeline import Localizer, stopwatch
from localizer.types import Frame, PoseEstimate, PosePrior, ReferenceBundle

_log = logging.getLogger(__name__)
_IDLE_S = 0.2
_REPORT_EVERY_S = 5.0
_DEFAULT_INTERVAL_NS = 100_000_000

Subscriber = Callable[[PoseEstimate, ReferenceBundle], None]
PriorProvider = Callable[[int], PosePrior | None]


@dataclass(frozen=True)
class EngineHealth:
    """Counters since the start, the last error's text ("" when none is standing), and which
    renderer, feature network and optimizer serve.
    """

    frames_in: int = 0
    frames_dropped: int = 0
    localized: int = 0
    accepted: int = 0
    references: int = 0
    errors: int = 0
    last_error: str = ""
    renderer: str = ""
    features: str = ""
    optimizer: str = ""


class DualThreadEngine:
    """Runs a `Localizer` on a render thread and a localization thread.

    subscribers: called on the localization thread with every estimate; they must not block.
    prior_provider: asked, with a time in ns, for a pose from outside when there is none or when
    tracking is LOST.
    """

    def __init__(
        self,
        localizer: Localizer,
        subscribers: tuple[Subscriber, ...],
        prior_provider: PriorProvider,
    ) -> None:
        self._localizer = localizer
        self._subscribers = subscribers
        self._prior_provider = prior_provider
        self._frames: Mailbox[Frame] = Mailbox()
        self._render_times: Mailbox[int] = Mailbox()
        self._bundle: ReferenceBundle | None = None
        self._reported_s = -_REPORT_EVERY_S
        self._interval_ns = _DEFAULT_INTERVAL_NS
        self._last_exposure_ns: int | None = None
        self._reference_ms: dict[str, float] = {}
        self._health = EngineHealth(
            renderer=localizer.renderer_name, features=localizer.features_name
        )
        self._health_lock = threading.Lock()
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, args=(self._render_once,), name="render"),
            threading.Thread(target=self._run, args=(self._localize_once,), name="localize"),
        ]

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop both threads and wait for them."""
        self._stop.set()
        self._frames.close()
        self._render_times.close()
        for thread in self._threads:
            thread.join()

    def submit(self, frame: Frame) -> None:
        """Offer a frame; an older one that was not yet taken is dropped. Never blocks."""
        self._frames.put(frame)
        self._count(frames_in=1)

    @property
    def health(self) -> EngineHealth:
        """A snapshot of the counters."""
        with self._health_lock:
            return replace(
                self._health,
                frames_dropped=self._frames.dropped,
                optimizer=self._localizer.optimizer_name,
            )

    def _run(self, once: Callable[[], None]) -> None:
        while not self._stop.is_set():
            try:
                once()
            except LocalizerError as error:
                self._report(str(error))
            except Exception as error:  # the flight goes on: degrade, report, try the next frame
                _log.exception("unexpected error on the %s thread", threading.current_thread().name)
                self._report(f"unexpected {type(error).__name__}: {error}")

    def _render_once(self) -> None:
        time_ns = self._render_times.take(_IDLE_S)
        if time_ns is None or (prior := self._localizer.predict(time_ns)) is None:
            return
        stage_ms: dict[str, float] = {}
        with stopwatch(stage_ms, "reference"):
            bundle = self._localizer.make_reference(prior)
        self._bundle, self._reference_ms = bundle, stage_ms
        self._count(references=1)
        self._localizer.prefetch(time_ns)  # last: nothing waits for it

    def _localize_once(self) -> None:
        frame = self._frames.take(_IDLE_S)
        if frame is None or not self._has_prior(frame.exposure_time_ns):
            return
        bundle, stage_ms = self._bundle, dict(self._reference_ms)
        try:
            if bundle is None:
                return
            with stopwatch(stage_ms, "extract"):
                query = self._localizer.extract_query(frame)
            estimate = self._localizer.localize(frame, query, bundle.anchors)
        finally:  # whatever became of this frame, the next one needs a reference
            self._render_times.put(self._next_exposure(frame))
        latency_ms = (time.monotonic_ns() - frame.exposure_time_ns) * 1e-6
        stage_ms |= estimate.stage_ms | {"latency": latency_ms}
        self._publish(replace(estimate, stage_ms=stage_ms), bundle)

    def _has_prior(self, time_ns: int) -> bool:
        """Whether there is a prediction to start from.

        Until the first acceptance, and again when LOST, the pose known outside is the better one.
        """
        tracker = self._localizer.tracker
        known = tracker.motion is not None
        if known and not tracker.integrity.wants_prior:
            return True
        prior = self._prior_provider(time_ns)
        if prior is None:
            return known
        self._localizer.set_prior(prior)
        return True

    def _next_exposure(self, frame: Frame) -> int:
        """When the frame after this one is expected, from a smoothed frame interval."""
        last = self._last_exposure_ns
        if last is not None:
            interval = frame.exposure_time_ns - last
            self._interval_ns += (min(max(interval, 1), 10**9) - self._interval_ns) // 4
        self._last_exposure_ns = frame.exposure_time_ns
        return frame.exposure_time_ns + self._interval_ns

    def _publish(self, estimate: PoseEstimate, bundle: ReferenceBundle) -> None:
        with self._health_lock:
            self._health = replace(self._health, last_error="")
        self._count(localized=1, accepted=int(estimate.accepted))
        for subscriber in self._subscribers:
            subscriber(estimate, bundle)

    def _report(self, text: str) -> None:
        with self._health_lock:
            self._health = replace(self._health, last_error=text)
        self._count(errors=1)
        now = time.monotonic()
        if now - self._reported_s > _REPORT_EVERY_S:
            self._reported_s = now
            _log.warning("%s", text)

    def _count(self, **increments: int) -> None:
        with self._health_lock:
            h = self._health
            self._health = replace(h, **{k: getattr(h, k) + n for k, n in increments.items()})
