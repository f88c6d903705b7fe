"""Runs a recorded flight through components of the flight process: which alerts and holds result.

The components are those of `companion.flight.component_table`, not started: bridge and integrity
monitor run by the record's clock, and frames are localized one after the other. Frames that a busy
processor would drop are not simulated.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from companion.calibration_watch.map_offset import MapOffsetEstimator
from companion.config import CompanionConfig
from companion.conversions import CameraExtrinsics
from companion.errors import RecordError, StreamDecodeError, StreamSizeError
from companion.flight.channels import FixInjection, is_for_injection
from companion.flight.component_table import COMPONENTS
from companion.flight.components import Assembly
from companion.flight.priors import AutopilotPose
from companion.flight.search import PlaceSearch
from companion.inertial import InertialTrack
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from companion.recorded.autopilot_log import vehicle_messages
from companion.recorded.flight import RecordedFlight
from companion.recorded.log_messages import Dated, origin_message, sent_by_autopilot
from companion.sources import VideoFileSource
from localizer.errors import MapLoadingError, OutsideMapError
from localizer.geometry.camera import Camera
from localizer.tracking.opening import MapStack
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PoseEstimate, ReferenceBundle
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, severity, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.injection.shadow import MINIMUM_SAMPLES, ShadowScore
from mavlink_bridge.vehicle.origin import offset

_KINDS = (
    MapStack, CameraExtrinsics, Bridge, InertialTrack, FixInjection, MapOffsetEstimator,
    IntegrityMonitor, AutopilotPose, Localizer, PlaceSearch,
)  # fmt: skip
_TICK_NS, _TURN_NS, _SCORE_NS = 50_000_000, 100_000_000, 1_000_000_000
_BEGIN_NS = 1_000_000_000_000  # of the record on its clock: as CLOCK_MONOTONIC some time after boot
_BEFORE_NS, _AFTER_NS = 10_000_000_000, 2_000_000_000  # of the log, about the images
_TOLD_BEFORE = ("HEARTBEAT", "AUTOPILOT_VERSION", "GPS_RAW_INT")
_TRIED_FRAMES = 5  # with the autopilot's pose, before the map is searched
_SEARCH_EVERY_NS = 5_000_000_000


@dataclass(frozen=True)
class ReportedText:
    """A text that the operator would have received. at_s: since the first image, negative before
    it; alert: its identifier.
    """

    at_s: float
    severity: int
    text: str
    alert: str = ""


@dataclass
class ShadowCheck:
    """Result of the check, counted while the flight plays. frames, localized, accepted: numbers of
    images; judged: fixes that the monitor checked, passed: those that it did not hold; seconds:
    duration of the images; go_s, first_go_s: how long the shadow check was ready, and from when (s
    from the first image), None: never; score: the last one with enough fixes; held_s: hold time by
    alert; lines: texts to the operator; notes: assumptions.
    """

    frames: int = 0
    localized: int = 0
    accepted: int = 0
    judged: int = 0
    passed: int = 0
    seconds: float = 0.0
    go_s: float = 0.0
    first_go_s: float | None = None
    score: ShadowScore = field(
        default_factory=lambda: ShadowScore(False, 0, (alert(AlertId.SHADOW_NOT_COMPARED),))
    )
    held_s: dict[str, float] = field(default_factory=dict)
    lines: list[ReportedText] = field(default_factory=list)
    notes: tuple[str, ...] = ()

    @property
    def go(self) -> bool:
        """Whether injection would have been allowed: the check was ready at some time and had no
        objection at the end.
        """
        return self.first_go_s is not None and not self.score.against


def shadow_check(
    flight: RecordedFlight,
    footage: Path,
    config: CompanionConfig,
    rate_hz: float,
    progress: Callable[[float, float], None] = lambda _done, _total: None,
) -> ShadowCheck:
    """Play the flight through the components. footage: what `flight` was read from; rate_hz: of the
    images, at most; progress: called with (done, all) seconds. `RecordError` if the footage has no
    log or no times.
    """
    if flight.log is None:
        raise RecordError(f"{footage}: no log of an autopilot lies beside it; give it as LOG")
    times = [f.time_ns for f in flight.frames if f.time_ns is not None]
    if not times:
        raise RecordError(f"{footage}: its images have no times")
    begin_ns = times[0] + flight.log.ahead_ns
    end_ns = times[-1] + flight.log.ahead_ns
    messages = _Messages(flight.log.path, begin_ns - _BEFORE_NS, end_ns + _AFTER_NS)
    delay_ns = round(1e6 * config.bridge.injection.delay_ms)
    frames = _frames(flight, footage, config.camera.model.camera(), rate_hz)
    to_record = _BEGIN_NS - begin_ns  # from the log's clock
    with ExitStack() as up:
        player = _Player(config, messages.origin, up)
        for message in messages.before:
            player.bridge.play(message)
        dated: Iterator[tuple[int, Any]] = heapq.merge(
            ((t + to_record, m) for t, m in messages.dated),
            ((f.exposure_time_ns + flight.log.ahead_ns + to_record + delay_ns, f) for f in frames),
            key=lambda one: one[0],
        )
        for now_ns, item in dated:
            player.advance(now_ns)
            if not isinstance(item, Frame):
                player.bridge.play(item)
                continue
            player.add_frame(replace(item, exposure_time_ns=now_ns - delay_ns))
            progress((now_ns - _BEGIN_NS) * 1e-9, (end_ns - begin_ns) * 1e-9)
        player.advance(player.now_ns + _AFTER_NS)
        return player.result((*flight.notes, *messages.notes))


class _Messages:
    """The log's messages during the images. dated: in the order of their times; before: messages
    that must be known at the begin; origin: the EKF's, GPS_GLOBAL_ORIGIN.
    """

    def __init__(self, path: Path, begin_ns: int, end_ns: int) -> None:
        self.notes: tuple[str, ...] = ()
        self.dated: list[Dated] = []
        before: dict[tuple[int, str], Any] = {}
        for time_ns, message in vehicle_messages(path):
            if time_ns < begin_ns:
                before[message.get_srcSystem(), message.get_type()] = message
            elif time_ns <= end_ns:
                self.dated.append((time_ns, message))
        self.dated.sort(key=lambda one: one[0])
        if not self.dated:
            raise RecordError(f"{path}: holds nothing of the time of the images")
        self.before = tuple(m for (_, kind), m in before.items() if kind in _TOLD_BEFORE)
        every = (*before.values(), *(m for _, m in self.dated))
        told = [m for m in every if m.get_type() == "GPS_GLOBAL_ORIGIN"]
        self.origin = told[-1] if told else self._origin(path)

    def _origin(self, path: Path) -> Any:
        """The EKF's origin, by local and global position at one time; else its first position."""
        local, place = None, None
        for _, message in self.dated:
            if message.get_type() == "LOCAL_POSITION_NED":
                local = message
            elif message.get_type() == "GLOBAL_POSITION_INT" and message.lat:
                place = place or message
                if local is not None and abs(message.time_boot_ms - local.time_boot_ms) <= 100:
                    place = message
                    break
        else:
            local = None
        if place is None:
            raise RecordError(f"{path}: states no position at the time of the images")
        north, east, down = (0.0, 0.0, 0.0) if local is None else (local.x, local.y, local.z)
        at = offset(place.lat * 1e-7, place.lon * 1e-7, -north, -east)
        self.notes = (
            f"{path.name} does not state the EKF's origin: "
            + ("by its positions" if local is not None else "its first position stands for it"),
        )
        return next(sent_by_autopilot(0, origin_message(at, place.alt * 1e-3 + down)))[1]


def _frames(
    flight: RecordedFlight, footage: Path, camera: Camera, rate_hz: float
) -> Iterator[Frame]:
    """The images on the footage's own clock, at most rate_hz of them a second."""
    last_ns: int | None = None
    for frame in _video(footage, camera) if flight.kind == "video" else _photos(flight, camera):
        if last_ns is None or frame.exposure_time_ns - last_ns >= 0.95e9 / rate_hz:
            last_ns = frame.exposure_time_ns
            yield frame


def _video(path: Path, camera: Camera) -> Iterator[Frame]:
    first_ns: int | None = None
    for frame in VideoFileSource(path, camera).frames():
        first_ns = frame.exposure_time_ns if first_ns is None else first_ns
        yield replace(frame, exposure_time_ns=frame.exposure_time_ns - first_ns)


def _photos(flight: RecordedFlight, camera: Camera) -> Iterator[Frame]:
    for sequence, one in enumerate(flight.frames):
        if one.time_ns is not None:
            with suppress(StreamDecodeError, StreamSizeError):
                yield one.load(camera, one.time_ns, sequence)


class _Player:
    """The components of one flight under the record's clock. origin: GPS_GLOBAL_ORIGIN, with which
    the vehicle answers requests.
    """

    def __init__(self, config: CompanionConfig, origin: Any, up: ExitStack) -> None:
        self.now_ns, self._origin = _BEGIN_NS - _BEFORE_NS, origin
        self._parts = Assembly(
            _shadow(config), [p for p in COMPONENTS if p.kind in _KINDS], lambda: self.now_ns
        )
        self._counts, self._held, self._problem = ShadowCheck(), Counter[str](), ""
        self._parts.channels.alerts.subscribe(self._told)
        self._parts.make(up)
        self.bridge, self._monitor = self._parts[Bridge], self._parts.get(IntegrityMonitor)
        injection = self._parts[FixInjection]
        injection.add_check(self._passed)
        self._localizer, self._search = self._parts[Localizer], self._parts[PlaceSearch]
        self._search.prepare()
        self._reference: ReferenceBundle | None = None
        self._unknown, self._searched_ns = 0, 0
        self._begun_ns: int | None = None
        self._last_ns = 0

    def advance(self, time_ns: int) -> None:
        """Do everything that is due until time_ns."""
        while (next_ns := (self.now_ns // _TICK_NS + 1) * _TICK_NS) <= time_ns:
            self.now_ns = next_ns
            self.bridge.tick()
            state = self.bridge.state()
            if state.connected and state.origin is None:
                self.bridge.play(self._origin)
            if self._monitor is not None and next_ns % _TURN_NS == 0:
                self._monitor.run_checks()
                if (reason := self._monitor.reason) is not None:
                    self._held[reason.id.value] += 1
            if next_ns % _SCORE_NS == 0 and self._begun_ns is not None:
                self._score()
        self.now_ns = max(self.now_ns, time_ns)

    def add_frame(self, frame: Frame) -> None:
        """Localize an image and inject its fix in shadow mode."""
        self._begun_ns = self._begun_ns or frame.exposure_time_ns
        self._last_ns = frame.exposure_time_ns
        self._counts.frames += 1
        self._parts.channels.frames.send(frame)
        self._search.keep(frame)
        try:
            estimate = self._estimate(frame)
        except (OutsideMapError, MapLoadingError) as error:
            self._problem = str(error)
            return
        if estimate is None or self._reference is None:
            return
        self._counts.localized += 1
        self._counts.accepted += estimate.accepted
        self._counts.judged += is_for_injection(estimate)
        self._parts.channels.estimates.send(estimate, self._reference)
        self.bridge.tick()

    def result(self, notes: tuple[str, ...]) -> ShadowCheck:
        """The result of all images."""
        if not self._counts.localized:
            notes = (*notes, f"no image was localized: {self._problem or 'no position is known'}")
        seconds = (self._last_ns - (self._begun_ns or self._last_ns)) * 1e-9
        held_s = {of: count * _TURN_NS * 1e-9 for of, count in self._held.most_common()}
        return replace(self._counts, seconds=seconds, held_s=held_s, notes=notes)

    def _estimate(self, frame: Frame) -> PoseEstimate | None:
        """Localize as `DualThreadEngine`, its threads' work in turn; None without a prior."""
        localizer, time_ns = self._localizer, frame.exposure_time_ns
        wants = localizer.tracker.track_status.wants_prior
        self._unknown = self._unknown + 1 if wants else 0
        if wants:
            known = self._found(frame) or self._parts[AutopilotPose].prior(time_ns)
            if known is not None:
                localizer.offer(known)
        prior = localizer.predict(time_ns)
        if prior is None:
            return None
        self._reference = localizer.reference_for(prior, self._reference, wait=True)
        query = localizer.extract_query(frame)
        return localizer.localize(frame, query, self._reference.anchors)

    def _found(self, frame: Frame) -> Any:
        due = frame.exposure_time_ns - self._searched_ns >= _SEARCH_EVERY_NS
        if self._unknown <= _TRIED_FRAMES or not due:
            return None
        self._searched_ns = frame.exposure_time_ns
        return self._search.search(frame, lambda: False)

    def _score(self) -> None:
        score = self.bridge.shadow_score()
        if score.samples >= MINIMUM_SAMPLES or self._counts.score.samples < MINIMUM_SAMPLES:
            self._counts.score = score
        if score.ready:
            self._counts.go_s += _SCORE_NS * 1e-9
            if self._counts.first_go_s is None:
                self._counts.first_go_s = self._since_s()

    def _passed(self, fix: Any) -> Any:
        self._counts.passed += 1
        return fix

    def _told(self, of: Alert) -> None:
        line = ReportedText(self._since_s(), severity(of), text(of), of.id.value)
        self._counts.lines.append(line)

    def _since_s(self) -> float:
        return (self.now_ns - _BEGIN_NS) * 1e-9


def _shadow(config: CompanionConfig) -> CompanionConfig:
    """The deployment in shadow mode, without record and state files."""
    bridge = config.bridge.model_copy(update={"mode": "shadow", "tlog": None, "state_file": None})
    return config.model_copy(update={"bridge": bridge, "record": None})
