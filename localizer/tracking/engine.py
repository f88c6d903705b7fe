"""The dual-thread engine (paper, Sec.

3.2): rendering runs parallel to localization. The localization thread takes the newest frame,
registers it against the newest reference and publishes the estimate. An extraction thread computes
the next frame's features meanwhile. After each estimate the render thread predicts the pose at the
next exposure, renders a reference there unless the last one is still valid, and prefetches the map
ahead. No thread waits for a subscriber or ends because of an error; errors are counted, logged and
reported as the engine's health. While no position is known, a further thread searches for one, and
the localization thread tests its results.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from localizer.errors import LocalizerError
from localizer.tracking.engine_health import EngineHealth, HealthCounters
from localizer.tracking.mailbox import FeaturePrefetcher, Mailbox, PrefetchedFrame
from localizer.tracking.pipeline import Localizer, stopwatch
from localizer.types import (
    Frame,
    PoseEstimate,
    PosePrior,
    ReferenceBundle,
    RegistrationStatus,
    TrackingState,
)

_log = logging.getLogger(__name__)
_IDLE_S = 0.2
_DEFAULT_INTERVAL_NS = 100_000_000

Subscriber = Callable[[PoseEstimate, ReferenceBundle], None]
PriorProvider = Callable[[int], PosePrior | None]
# Searches for a place in one frame; None when none was found. It is told by the callable when to
# stop: the place was found otherwise, or the engine ends.
Searcher = Callable[[Frame, Callable[[], bool]], PosePrior | None]

_FIX_THREADS = ("render", "extract", "localize")
# With what is known outside, before a search begins: so many frames, or so long at a low rate.
_TRIED_FRAMES, _TRIED_NS = 5, 1_000_000_000
# While a search runs, one frame in so many is tried with what is known outside: what led nowhere
# for `_TRIED_FRAMES` seldom does, and takes half a processor from the search, which then answers
# for where the vehicle was seconds ago.
_TRIED_BESIDE = 3
_SEARCH_HANGS_NS = 120_000_000_000  # without asking whether it is wanted, as it does all the time
_STOP_S = 10.0  # for a search to see that it is to end
_FIX_STOP_S = 20.0  # for a frame that is at work to be done, on a slow computer


class DualThreadEngine:
    """Runs a `Localizer` on a render, an extraction and a localization thread.

    Above 200 lines: a few lines for each cycle of each thread, and all share one state.

    subscribers: called on the localization thread with every estimate; they must not block.
    prior_provider: called there with a time in ns for an external pose if there is none or tracking
    is LOST. searcher: finds a position without a prior, on its own thread. If it shows no progress
    for two minutes, the hang is reported and frames no longer wait for it. clock: CLOCK_MONOTONIC,
    ns.
    """

    def __init__(
        self,
        localizer: Localizer,
        subscribers: tuple[Subscriber, ...],
        prior_provider: PriorProvider,
        searcher: Searcher | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._localizer = localizer
        self._subscribers = subscribers
        self._prior_provider = prior_provider
        self._searcher = searcher
        self._sought: Mailbox[Frame] = Mailbox()
        self._found: PosePrior | None = None
        self._unknown_frames = self._left_frames = 0
        self._unknown_since_ns = 0
        self._clock = clock
        self._search_alive_ns: int | None = None  # while one is under way: when it last said so
        self._ahead = FeaturePrefetcher(localizer.extract_query, self._may_extract_ahead)
        self._registers = False  # whether the last frame was registered: the next will be, too
        self._render_times: Mailbox[int] = Mailbox()
        self._bundle: ReferenceBundle | None = None
        self._interval_ns = _DEFAULT_INTERVAL_NS
        self._last_exposure_ns: int | None = None
        self._reference_ms: dict[str, float] = {}
        self._book = HealthCounters(localizer.renderer_name, localizer.features_name)
        self._stop = threading.Event()
        self._last_ticks: dict[str, int] = {}
        self._threads = [
            self._thread("render", self._render_once),
            self._thread("extract", self._extract_once),
            self._thread("localize", self._localize_once),
        ]
        if searcher is not None:
            self._threads.append(self._thread("search", self._search_once))

    def start(self) -> None:
        """Start the threads; once in an engine's life."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop the threads and wait for each, at most 20 s (the search 10 s); one that does not end
        is logged and left behind. The localizer stays open.
        """
        self._stop.set()
        self._ahead.close()
        self._render_times.close()
        self._sought.close()
        for thread in self._threads:
            thread.join(_STOP_S if thread.name == "search" else _FIX_STOP_S)
            if thread.is_alive():
                _log.warning("the %s thread does not end, it is left behind", thread.name)

    def submit(self, frame: Frame) -> None:
        """Offer a frame, from any thread; it replaces a frame that waits. Never blocks."""
        self._ahead.put(frame)
        self._book.count(frames_in=1)

    @property
    def is_full(self) -> bool:
        """Whether a frame is waiting; the next one would replace it."""
        return self._ahead.is_full

    @property
    def health(self) -> EngineHealth:
        """A snapshot of the counters."""
        localizer = self._localizer
        return self._book.read(
            self._ahead.dropped, localizer.optimizer_name, localizer.attitude_bias
        )

    def last_ticks_ns(self) -> dict[str, int]:
        """Start of the newest cycle, CLOCK_MONOTONIC ns, of the threads "render", "extract" and
        "localize" that have begun. The search is left out, because a cycle of it takes minutes.
        """
        return {n: self._last_ticks[n] for n in _FIX_THREADS if n in self._last_ticks}

    def _thread(self, name: str, once: Callable[[], None]) -> threading.Thread:
        # A daemon: one that hangs must not keep the process from ending. All, the search too, are
        # of the process's own priority: a thread of a lower one that is put aside while it holds
        # the interpreter holds up all that fly (2 s at nice 15, 0.2 s without, on a busy
        # processor); and the ports of a killed process are free once its last thread had its turn.
        return threading.Thread(target=self._run, args=(once,), name=name, daemon=True)

    def _run(self, once: Callable[[], None]) -> None:
        name = threading.current_thread().name
        while not self._stop.is_set():
            self._last_ticks[name] = time.monotonic_ns()
            try:
                once()
            except LocalizerError as error:
                self._book.report(error)
            except Exception as error:  # the flight goes on: degrade, report, try the next frame
                _log.exception("unexpected error on the %s thread", threading.current_thread().name)
                self._book.report(error)

    def _search_once(self) -> None:
        """Search the newest frame's position while it is unknown."""
        frame = self._sought.take(_IDLE_S)
        if frame is None or self._searcher is None or self._knows_place():
            return
        self._searches(self._clock())
        try:
            found = self._searcher(frame, self._needs_no_search)
        finally:
            self._searches(None)
        self._book.count(searches=1, found=int(found is not None))
        self._book.clear_error()
        self._found = found

    def _needs_no_search(self) -> bool:
        """Stop condition, which a running search calls continuously; the calls also show that it
        does not hang.
        """
        self._search_alive_ns = self._clock()
        return self._knows_place()

    def _searches(self, begun_ns: int | None) -> None:
        self._search_alive_ns = begun_ns
        self._book.set_searching(begun_ns is not None)

    def _search_hangs(self) -> bool:
        """Whether the search no longer calls its stop condition; it is then reported, not waited
        for.
        """
        alive_ns = self._search_alive_ns
        hangs = alive_ns is not None and self._clock() - alive_ns > _SEARCH_HANGS_NS
        self._book.set_search_hangs(hangs)
        return hangs

    def _knows_place(self) -> bool:
        """Whether a search is pointless: the position is known or tentative, or we stop."""
        return self._stop.is_set() or not self._localizer.tracker.track_status.wants_prior

    def _render_once(self) -> None:
        time_ns = self._render_times.take(_IDLE_S)
        if time_ns is None or (prior := self._localizer.predict(time_ns)) is None:
            return
        stage_ms: dict[str, float] = {}
        with stopwatch(stage_ms, "reference"):
            bundle = self._localizer.reference_for(prior, self._bundle)
        is_new = bundle is not self._bundle
        self._bundle, self._reference_ms = bundle, stage_ms
        self._book.clear_error()
        if is_new:
            self._book.count(references=1)
            self._localizer.prefetch(time_ns)  # last: nothing waits for it

    def _extract_once(self) -> None:
        self._ahead.prepare(_IDLE_S)

    def _may_extract_ahead(self) -> bool:
        """Whether the next frame's features will be needed, and may be computed in parallel."""
        return self._registers

    def _localize_once(self) -> None:
        prepared = self._ahead.take(_IDLE_S)
        if prepared is None:
            return
        registered = False
        try:
            registered = self._localize(prepared)
        finally:
            self._registers = registered

    def _localize(self, prepared: PrefetchedFrame) -> bool:
        """Register a frame and publish the estimate; False if that is not possible yet."""
        frame = prepared.frame
        self._seek(frame)
        if self._is_left_to_search() or not self._has_prior(frame.exposure_time_ns):
            return False
        bundle, stage_ms = self._bundle, dict(self._reference_ms)
        try:
            if bundle is None:
                return False
            # Where the map ends there is no reference of now: the odometry may carry on, and
            # without it the prediction is judged alone.
            anchors = None if self._is_stale(bundle, frame) else bundle.anchors
            if anchors is None and not self._localizer.tracker.track_status.trusts_prediction:
                return False
            query, stage_ms["extract"] = prepared.features, prepared.extract_ms
            if query is None:
                with stopwatch(stage_ms, "extract"):
                    query = self._localizer.extract_query(frame)
            estimate = self._localizer.localize(frame, query, anchors)
        finally:  # whatever became of this frame, the next one needs a reference
            self._render_times.put(self._next_exposure(frame))
        latency_ms = (time.monotonic_ns() - frame.exposure_time_ns) * 1e-6
        stage_ms |= estimate.stage_ms | {"latency": latency_ms}
        self._publish(replace(estimate, stage_ms=stage_ms), bundle)
        return True

    def _has_prior(self, time_ns: int) -> bool:
        """Whether there is a prediction to start from.

        Until the first acceptance, and when LOST, a found position or an external pose replaces the
        prediction. An external pose that does not derive from our own fixes starts tracking. Any
        other one is tentative until it is confirmed.
        """
        tracker = self._localizer.tracker
        known = tracker.motion is not None
        if known and not tracker.track_status.wants_prior:
            if tracker.track_status.state is TrackingState.TRACKING:
                self._found = None  # of a loss that is over: at the next one it is another place
            return True
        found, self._found = self._found, None
        prior = found or self._prior_provider(time_ns)
        if prior is None:
            return known
        self._localizer.offer(prior)
        return True

    def _seek(self, frame: Frame) -> None:
        """Give the frame to the search, after the external poses were tried without success."""
        if self._searcher is None:
            return
        wanting = self._localizer.tracker.track_status.wants_prior
        self._unknown_frames = self._unknown_frames + 1 if wanting else 0
        if self._unknown_frames <= 1:
            self._unknown_since_ns = frame.exposure_time_ns
        tried_ns = frame.exposure_time_ns - self._unknown_since_ns
        if self._unknown_frames > _TRIED_FRAMES or tried_ns >= _TRIED_NS:
            self._sought.put(frame)

    def _is_left_to_search(self) -> bool:
        """Whether a frame is skipped so that a running search gets the processor."""
        runs = self._search_alive_ns is not None and not self._search_hangs()
        if not runs or self._found is not None or self._knows_place():
            self._left_frames = 0
            return False
        self._left_frames = (self._left_frames + 1) % _TRIED_BESIDE
        return self._left_frames != 0

    def _is_stale(self, bundle: ReferenceBundle, frame: Frame) -> bool:
        """Whether the reference is too old. A render thread that fails permanently is not hidden by
        an old reference.

        If the thread has an error, the reference is stale. Otherwise a reference of the position
        that is tried now is being rendered.
        """
        age_s = (frame.exposure_time_ns - bundle.time_ns) * 1e-9
        return abs(age_s) > self._localizer.reference_age_s

    def _next_exposure(self, frame: Frame) -> int:
        """Expected exposure of the next frame, from a smoothed frame interval."""
        last = self._last_exposure_ns
        if last is not None:
            interval = frame.exposure_time_ns - last
            self._interval_ns += (min(max(interval, 1), 10**9) - self._interval_ns) // 4
        self._last_exposure_ns = frame.exposure_time_ns
        return frame.exposure_time_ns + self._interval_ns

    def _publish(self, estimate: PoseEstimate, bundle: ReferenceBundle) -> None:
        if estimate.status is not RegistrationStatus.NO_OVERLAP:  # the reference's error stands
            self._book.clear_error()
        self._book.count(localized=1, accepted=int(estimate.accepted))
        for subscriber in self._subscribers:
            subscriber(estimate, bundle)
