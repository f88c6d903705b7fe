"""The table of components: how each component of the flight process is built, started and stopped.

A new component is a line in `COMPONENTS` and a function that makes it. It takes what it needs from
the components above it and subscribes to the channels that it reads.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from companion.calibration_watch.map_offset import MapOffsetEstimator
from companion.config import CompanionConfig
from companion.conversions import CameraExtrinsics, target_report
from companion.errors import ConfigError
from companion.flight.calibration_observer import CalibrationObserver
from companion.flight.channels import Feed, FixInjection, is_for_injection
from companion.flight.components import Assembly, Component
from companion.flight.health import HealthInputs, HealthMonitor
from companion.flight.last_fix import FixMemory
from companion.flight.priors import AutopilotPose, local_near
from companion.flight.reachable_region import ReachableRegion
from companion.flight.recorder import RecordKeeper, remove_empty
from companion.flight.search import PlaceSearch, enu_on_map
from companion.ground.vital_signs import ViewReporter, VitalSigns
from companion.inertial import InertialTrack
from companion.integrity_monitor.checks import IntegrityLimits
from companion.integrity_monitor.debouncer import InhibitMemory
from companion.integrity_monitor.integrity_monitor import IntegrityMonitor
from companion.klv.metadata import KlvContext
from companion.klv.relay import KlvRelay
from companion.live.orders import OrderContext, OrderError, Orders
from companion.live.protocol import socket_path
from companion.live.publisher import Publisher
from companion.live.shown import ConsoleData, Instruments
from companion.preflight.coverage import check_origin
from companion.preflight.map_pin import readable_map_hash, require_pinned
from companion.sources import FrameSource, PacketTap, StreamState, open_source
from companion.sources.timing import system_minus_monotonic
from companion.sources.zoom import ZoomedFrames
from companion.targets.clicks import ClickPolicy
from companion.targets.detections import DetectionListener, TargetNumbers
from companion.targets.detector.worker import BoxDetector
from companion.targets.frame_times import FrameTimes
from companion.targets.reporter import TargetReporter
from companion.targets.target_manager import TargetEstimate
from localizer.geometry.pose import matrix_from_quaternion
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from localizer.map.inspection.kind import map_kind
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.motion import AuxiliarySensors
from localizer.tracking.opening import MapStack, build_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PoseEstimate, ReferenceBundle
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, severity, text
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import TrackRequest

_log = logging.getLogger(__name__)
_FOCAL_FIT_S = 0.5  # where the table may be corrected: 5 ms of processor each
_ZOOM_RATE_HZ = 5.0  # at which CAMERA_SETTINGS is asked for where a table waits for it
_WARNING = 4  # MAV_SEVERITY_WARNING; lower is worse
_BAD_FEED = (StreamState.STALLED, StreamState.FAILED, StreamState.SCALED, StreamState.MISFIT)


def _map(context: Assembly) -> MapStack:
    config = context.config
    require_pinned(config.map, config.map_sha256)
    stack = MapStack(config.map, config.localizer)
    try:
        _require_origin_at_map(config, stack.cache)
    except BaseException:
        stack.close()
        raise
    return stack


def _extrinsics(context: Assembly) -> CameraExtrinsics:
    cache = context[MapStack].cache
    arm = np.array(context.config.camera.lever_arm_m)
    return CameraExtrinsics(cache.frame, cache.manifest.geoid_separation_m, arm)


def _bridge(context: Assembly) -> Bridge:
    search = context.later(PlaceSearch)
    bridge = Bridge(
        _bridge_config(context.config),
        context[MapStack].cache.manifest.geoid_separation_m,
        on_track=context.channels.clicks.send,
        on_hint=lambda hint: search().hint_at(hint),
        on_alert=context.channels.alerts.send,
        clock=context.clock,
    )
    bridge.set_map_id(readable_map_hash(context.config.map) or "")
    return bridge


def _record(context: Assembly) -> RecordKeeper:
    bridge, channels, config = context[Bridge], context.channels, context.config

    def incomplete(why: str) -> None:
        _log.warning("the record is incomplete: %s", why)
        bridge.report_alert(alert(AlertId.RECORD_INCOMPLETE))

    keeper = RecordKeeper(context[MapStack].cache.frame, incomplete)
    if config.record is None:
        return keeper

    def claim(folder: Path) -> None:
        context.on_failed_start(lambda: remove_empty(folder))

    keeper.open(config, config.record, claim)
    recorder = keeper.recorder
    if recorder is not None:
        channels.frames.subscribe(recorder.snapshot)
        integrity_monitor = context.get(IntegrityMonitor)

        def record(estimate: PoseEstimate, _: ReferenceBundle) -> None:
            recorder.estimate(estimate, _protection_levels(integrity_monitor, estimate))

        channels.estimates.subscribe(record)
        channels.targets.subscribe(lambda target: recorder.target(target.fix))
        channels.events.subscribe(recorder.event)

        # What the operator was told belongs in the record; the bridge has logged it.
        def told(of: Alert) -> None:
            recorder.event(_level(severity(of)), text(of), of.id.value)

        channels.alerts.subscribe(told)
    return keeper


def _source(context: Assembly) -> FrameSource:
    camera, events, bridge = context.config.camera, context.channels.events, context[Bridge]

    def on_state(state: StreamState, text: str) -> None:
        events.send("warning" if state in _BAD_FEED else "info", f"feed: {text}")

    def on_stranger(host: str) -> None:
        bridge.report_alert(alert(AlertId.VIDEO_SENDER_IGNORED, host=Name(host)))

    model = camera.model.camera()
    wanted: tuple[PacketTap | None, ...] = (context.get(KlvRelay), context.get(FrameTimes))
    taps = (tap for tap in wanted if tap is not None)
    return open_source(camera.source, model, camera.settings, on_state, on_stranger, *taps)


def _frame_times(context: Assembly) -> FrameTimes:
    targets = context.later(TargetReporter)
    times = FrameTimes(lambda detection: targets().add_detection(detection))
    context.channels.frames.subscribe(times.add_frame)
    return times


def _klv(context: Assembly) -> KlvRelay:
    config, bridge, cache = context.config, context[Bridge], context[MapStack].cache
    assert config.klv is not None  # or the part is not wanted
    if not config.camera.is_video:
        raise ConfigError(f"klv: {config.camera.source} is no video that could be sent on")
    geoid_m = cache.manifest.geoid_separation_m
    scene = KlvContext(cache.frame, MapSurface(cache).cast, geoid_m, config.klv.mission)

    def attitude(time_ns: int) -> np.ndarray | None:
        known = bridge.attitude_at(time_ns)
        return None if known is None else matrix_from_quaternion(known.quaternion)

    relay = KlvRelay(config.klv, scene, attitude, system_minus_monotonic())
    context.channels.estimates.subscribe(lambda estimate, _: relay.add_estimate(estimate))
    context.channels.targets.subscribe(relay.add_target)
    return relay


def _health(context: Assembly) -> HealthMonitor:
    engine, keeper = context.later(DualThreadEngine), context[RecordKeeper]
    streamer = context[MapStack].streamer
    autopilot, search = context.later(AutopilotPose), context.later(PlaceSearch)
    source = context[FrameSource]  # type: ignore[type-abstract]
    inputs = HealthInputs(
        lambda: keeper.is_complete,
        lambda: autopilot().sigma_m,
        context.get(IntegrityMonitor),
        lambda: streamer.counters().unreadable,
        context[MapOffsetEstimator].report,
        _target_counts(context),
        lambda: search().lacks,
    )
    health = HealthMonitor(
        lambda: engine().health,
        context[Bridge],
        lambda: source.state,
        context.channels.events.send,
        keeper.folder,
        inputs,
    )
    context.channels.estimates.subscribe(lambda estimate, _: health.add_estimate(estimate))
    return health


def _targets(context: Assembly) -> TargetReporter:
    channels, bridge = context.channels, context[Bridge]
    cache, numbers = context[MapStack].cache, TargetNumbers()
    reporter = TargetReporter(
        context.config.targets.for_map(map_kind(cache)),
        MapSurface(cache).cast,
        channels.targets.send,
        channels.gone.send,
        bridge.report_alert,
    )

    def report(target: TargetEstimate) -> None:
        camera, number = target.estimate.camera, numbers.number_of(target.fix.target_id)
        bridge.report(target_report(target.fix, camera, cache.frame, number))

    channels.frames.subscribe(reporter.add_frame)
    channels.estimates.subscribe(lambda estimate, _: reporter.add_estimate(estimate))
    channels.targets.subscribe(report)
    channels.gone.subscribe(lambda name: bridge.forget(numbers.number_of(name)))
    return reporter


def _clicks(context: Assembly) -> ClickPolicy:
    report, config = context[Bridge].report_alert, context.config.targets
    clicks = ClickPolicy(context[TargetReporter], report, config)
    context.channels.estimates.subscribe(clicks.add_estimate)
    context.channels.clicks.subscribe(clicks.on_request)
    context.channels.gone.subscribe(clicks.on_gone)
    return clicks


def _detections(context: Assembly) -> DetectionListener:
    address = context.config.targets.detections
    assert address is not None  # or the part is not wanted
    return DetectionListener(address, context[FrameTimes].add_detection)


def _detector(context: Assembly) -> BoxDetector:
    channels, reporter = context.channels, context[TargetReporter]
    config = context.config.targets.detector
    assert config is not None  # or the part is not wanted
    cast = MapSurface(context[MapStack].cache).cast
    detector = BoxDetector(config, cast, reporter.add_detection, context[Bridge].report_alert)
    channels.frames.subscribe(detector.add_frame)
    channels.estimates.subscribe(lambda estimate, _: detector.add_estimate(estimate))
    return detector


def _target_counts(context: Assembly) -> Callable[[], dict[str, int]]:
    """A function that counts clicks and detections without a position, for health and report."""
    targets, times = context.later(TargetReporter), context.get(FrameTimes)
    has_detector = context.config.targets.detector is not None
    detector = context.later(BoxDetector) if has_detector else None

    def counts() -> dict[str, int]:
        reporter = targets()
        return {
            "missed": reporter.missed,
            "doubted": reporter.doubted,
            "refused": reporter.refused,
            "failed": reporter.failed + (0 if detector is None else detector().failed),
            "unmatched": reporter.unmatched + (0 if times is None else times.unmatched),
        }

    return counts


def _view(context: Assembly) -> ViewReporter:
    cache, bridge = context[MapStack].cache, context[Bridge]
    rate_hz = context.config.bridge.targets.rate_hz
    view = ViewReporter(rate_hz, cache.frame, MapSurface(cache).cast, bridge.report_view)
    context.channels.estimates.subscribe(lambda estimate, _: view.add_estimate(estimate))
    return view


def _vital_signs(context: Assembly) -> VitalSigns:
    signs = VitalSigns(context[Bridge].send_named_values)
    context.channels.estimates.subscribe(lambda estimate, _: signs.add_estimate(estimate))
    return signs


def _autopilot(context: Assembly) -> AutopilotPose:
    bridge = context[Bridge]
    autopilot = AutopilotPose(bridge, context[CameraExtrinsics], lambda: bridge.on_gnss)
    context.channels.estimates.subscribe(
        lambda estimate, _: autopilot.add_estimate(estimate, reaches_ekf=bridge.reaches_ekf)
    )
    return autopilot


def _last_fix(context: Assembly) -> FixMemory:
    config, bridge = context.config, context[Bridge]
    integrity_monitor = context.get(IntegrityMonitor)
    folder = config.state_folder
    memory = FixMemory(
        folder and folder / "last-fix.json",
        context[AutopilotPose],
        context[CameraExtrinsics],
        lambda time_ns: local_near(bridge, time_ns),
        lambda: integrity_monitor is None or not integrity_monitor.reason,
        bridge.state,
    )
    context.channels.estimates.subscribe(memory.add_estimate)
    return memory


def _localizer(context: Assembly) -> Localizer:
    _log.info("making the localizer ready; the first start on a machine compiles its kernels")
    config, autopilot = context.config, context.later(AutopilotPose)
    camera = config.camera.model.camera()
    sensors = AuxiliarySensors(
        lambda time_ns: autopilot().rotation(time_ns),
        lambda begin_ns, end_ns: autopilot().displacement(begin_ns, end_ns),
        lambda _time_ns: autopilot().height_m,
        lambda time_ns: autopilot().clearance_m(time_ns),
    )
    settings, zoom = config.localizer, config.camera.zoom
    if zoom is not None and zoom.refine and not settings.focal_fit_s:
        settings = settings.model_copy(update={"focal_fit_s": _FOCAL_FIT_S})
    return build_localizer(context[MapStack], camera, settings, sensors)


def _injection(context: Assembly) -> FixInjection:
    injection = FixInjection(context[Bridge], context[CameraExtrinsics])
    context.channels.estimates.subscribe(injection.add_estimate)
    return injection


def _map_shift(context: Assembly) -> MapOffsetEstimator:
    injection = context.config.bridge.injection
    shift = MapOffsetEstimator(
        context[Bridge],
        injection.map_shift,
        context.channels.events.send,
        gnss_is_ours=injection.message == "gps_input",
    )
    fixes = context[FixInjection]
    fixes.add_observer(lambda estimate, _, fix: shift.add_fix(estimate, fix))
    if injection.map_shift == "apply":
        fixes.add_check(shift.corrected)  # first, so that the others compare it with GNSS
    return shift


def _integrity_monitor(context: Assembly) -> IntegrityMonitor:
    config, injection = context.config, context.config.bridge.injection
    limits = IntegrityLimits(
        injection.alert_limit_m,
        injection.time_to_alert_s,
        gnss_is_ours=injection.message == "gps_input",
        horizontal_fov_deg=config.camera.model.camera().horizontal_fov_deg,
    )
    calibrated = config.camera.is_calibrated(datetime.now(timezone.utc).date())
    protection = config.integrity_monitor.protection.of_camera(calibrated=calibrated)
    watched = config.integrity_monitor.model_copy(update={"protection": protection})
    memory, track = _inhibit_memory(config), context[InertialTrack]
    integrity_monitor = IntegrityMonitor(
        watched, limits, context[Bridge], memory, context.clock, track
    )
    context[FixInjection].add_check(integrity_monitor.check)
    context.channels.frames.subscribe(
        lambda f: integrity_monitor.add_frame(f.exposure_time_ns, f.image)
    )
    observer = CalibrationObserver(context[CameraExtrinsics], integrity_monitor.add_observation)
    context[FixInjection].add_observer(observer.add_fix)
    return integrity_monitor


def _feed(context: Assembly) -> Feed:
    source = context[FrameSource]  # type: ignore[type-abstract]
    return Feed(source, context.channels.frames.send)


def _console(context: Assembly) -> Publisher:
    """Build the console's server. It only reads from the flight. It subscribes last and keeps
    references to frames, no copies.
    """
    config, bridge, channels = context.config, context[Bridge], context.channels
    assert config.console is not None  # or the part is not wanted
    cache, search, health = context[MapStack].cache, context[PlaceSearch], context[HealthMonitor]
    geoid_m = cache.manifest.geoid_separation_m
    instruments = Instruments(
        lambda: health.newest, bridge.state, bridge.shadow_score, bridge.loop_verdict,
        lambda: bridge.injecting and bridge.reaches_ekf, bridge.mission,
    )  # fmt: skip
    folder = context[RecordKeeper].folder
    about = {
        "map": str(config.map),
        "record": None if folder is None else str(folder),
        "control": config.console.control,
        "mode": config.bridge.mode,
        "delay_ms": config.bridge.injection.delay_ms,
        "alert_limit_m": config.bridge.injection.alert_limit_m,
    }
    shown = ConsoleData(cache.frame, geoid_m, instruments, about)

    def hint(latitude_deg: float, longitude_deg: float, radius_m: float) -> None:
        place = enu_on_map(cache, latitude_deg, longitude_deg, radius_m)
        if place is None:
            raise OrderError("the hint lies off the map")
        search.hint(*place, radius_m)

    # A click of the page names its frame; a ground station's is taken to be late.
    late_ns = round(config.targets.operator_delay_ms * 1e6)

    def track(request: TrackRequest) -> None:
        bridge.track(replace(request, time_ns=request.time_ns + late_ns))

    order_context = OrderContext(bridge.report_alert, track, hint)
    orders = Orders(config.console.control, order_context)
    record = None if config.record is None else config.record.folder
    path = socket_path(config.map, record, config.console.listen)
    publisher = Publisher(path, shown, orders, config.console.frames_hz)

    def see(frame: Frame) -> None:
        if publisher.is_watched:
            shown.add_frame(frame)

    def estimated(estimate: PoseEstimate, bundle: ReferenceBundle) -> None:
        shown.add_estimate(estimate, bundle)
        if publisher.is_watched:
            publisher.wake()

    channels.frames.subscribe(see)
    channels.estimates.subscribe(estimated)
    channels.targets.subscribe(shown.add_target)
    channels.gone.subscribe(shown.forget_target)
    channels.events.subscribe(shown.add_event)
    channels.alerts.subscribe(lambda of: shown.add_event(_level(severity(of)), text(of)))
    return publisher


def _search(context: Assembly) -> PlaceSearch:
    cache, channels, reach = (
        context[MapStack].cache,
        context.channels,
        ReachableRegion(context[Bridge], context[InertialTrack]),
    )
    channels.estimates.subscribe(reach.add_estimate)
    channels.frames.subscribe(lambda _frame: reach.follow())
    return PlaceSearch(
        cache, context.config.localizer, context[AutopilotPose], channels.events.send, reach.region
    )


def _engine(context: Assembly) -> DualThreadEngine:
    channels, memory, autopilot = context.channels, context[FixMemory], context[AutopilotPose]
    engine = DualThreadEngine(
        context[Localizer],
        (channels.estimates.send,),
        lambda time_ns: memory.prior(time_ns) or autopilot.prior(time_ns),
        context[PlaceSearch].search,
    )
    keep = context[PlaceSearch].keep
    table, bridge = context.config.camera.zoom, context[Bridge]
    if table is None:
        channels.frames.subscribe(engine.submit)
        channels.frames.subscribe(keep)
        return engine
    zoomed = ZoomedFrames(table, bridge.zoom_at, bridge.report_alert)

    def submit(frame: Frame) -> None:
        known = zoomed(frame)
        if known is not None:
            engine.submit(known)
            keep(known)

    channels.frames.subscribe(submit)
    channels.estimates.subscribe(lambda estimate, _: zoomed.learn(estimate))
    return engine


# In this order the parts are made and then started, and in the reverse order stopped and then
# closed. What gives an estimate's age its last milliseconds, injection, is served first. A wrong
# source and a port in use are found before the localizer, whose compilation takes its time; the
# record is closed after all that could tell it something.
COMPONENTS: tuple[Component[Any], ...] = (
    Component("map", MapStack, _map, close=MapStack.close, ahead=True),
    Component("installation", CameraExtrinsics, _extrinsics),
    Component(
        "bridge", Bridge, _bridge,
        start=Bridge.start, stop=Bridge.stop, close=Bridge.stop,  # one not started has files open
        hand_over=Bridge.hand_over,
    ),
    Component("IMU", InertialTrack, lambda _: InertialTrack()),
    Component("injection", FixInjection, _injection),
    Component("map shift", MapOffsetEstimator, _map_shift),
    Component(
        "integrity monitor", IntegrityMonitor, _integrity_monitor,
        start=IntegrityMonitor.start, stop=IntegrityMonitor.stop, close=IntegrityMonitor.close,
        hand_over=IntegrityMonitor.hand_over,
        wanted=lambda config: config.integrity_monitor.enabled,
    ),
    Component("record", RecordKeeper, _record, start=RecordKeeper.link, close=RecordKeeper.close),
    Component(
        "klv", KlvRelay, _klv, start=KlvRelay.start, stop=KlvRelay.stop,
        wanted=lambda config: config.klv is not None,
    ),
    Component(
        "frame times", FrameTimes, _frame_times,
        wanted=lambda config: config.targets.detections is not None,
    ),
    Component("source", FrameSource, _source),
    Component(
        "health", HealthMonitor, _health, start=HealthMonitor.start, stop=HealthMonitor.stop
    ),
    Component(
        "targets", TargetReporter, _targets, start=TargetReporter.start, stop=TargetReporter.stop
    ),
    Component("clicks", ClickPolicy, _clicks),
    Component(
        "detections", DetectionListener, _detections, close=DetectionListener.close,
        wanted=lambda config: config.targets.detections is not None,
    ),
    Component(
        "detector", BoxDetector, _detector, start=BoxDetector.start, stop=BoxDetector.stop,
        wanted=lambda config: config.targets.detector is not None,
    ),
    Component("autopilot", AutopilotPose, _autopilot),
    Component(
        "last fix", FixMemory, _last_fix,
        start=FixMemory.start, stop=FixMemory.stop, hand_over=FixMemory.hand_over,
    ),
    Component("localizer", Localizer, _localizer, ahead=True),
    Component(
        "view", ViewReporter, _view, start=ViewReporter.start, stop=ViewReporter.stop,
        wanted=lambda config: config.bridge.camera.announce or config.bridge.targets.cot_aircraft,
    ),
    Component(
        "vital signs", VitalSigns, _vital_signs, start=VitalSigns.start, stop=VitalSigns.stop,
        wanted=lambda config: config.bridge.named_values,
    ),
    Component(
        "search", PlaceSearch, _search,
        start=PlaceSearch.start, stop=PlaceSearch.stop, close=PlaceSearch.close,
    ),
    Component(
        "console", Publisher, _console,
        start=Publisher.start, stop=Publisher.stop, close=Publisher.close,
        wanted=lambda config: config.console is not None,
    ),
    Component(
        "engine", DualThreadEngine, _engine,
        start=DualThreadEngine.start, stop=DualThreadEngine.stop,
    ),
    Component("feed", Feed, _feed, start=Feed.start, stop=Feed.stop),
)  # fmt: skip


def _protection_levels(
    integrity_monitor: IntegrityMonitor | None, estimate: PoseEstimate
) -> tuple[float, float] | None:
    """Horizontal and vertical protection level of the estimate, m; None if it is not for injection.
    The monitor has checked it before, because injection subscribes earlier.
    """
    level = None if integrity_monitor is None else integrity_monitor.level
    if level is None or not is_for_injection(estimate):
        return None
    return level.horizontal_m, level.vertical_m


def _level(severity: int) -> str:
    return "warning" if severity <= _WARNING else "info"


def _require_origin_at_map(config: CompanionConfig, cache: TileCache) -> None:
    """Raise `ConfigError` if the configured EKF origin is far from the map: the vehicle keeps a
    wrong origin until it is switched off.
    """
    if config.bridge.origin is not None:
        finding = check_origin(config.bridge.origin, cache)
        if not finding.ok:
            raise ConfigError(f"bridge.origin: {finding.found} (needed {finding.needed})")


def _bridge_config(config: CompanionConfig) -> BridgeConfig:
    """The bridge's settings, with the camera of the video and a state folder beside the record."""
    camera = config.camera.model.camera()
    announced = config.bridge.camera.model_copy(
        update={
            "width_px": camera.width,
            "height_px": camera.height,
            "horizontal_fov_deg": camera.horizontal_fov_deg,
        }
        | ({"zoom_rate_hz": _ZOOM_RATE_HZ} if config.camera.zoom is not None else {})
    )
    targets = config.bridge.targets.model_copy(update={"rate_hz": config.targets.rate_hz})
    update = {"camera": announced, "targets": targets, "state_file": _state_file(config)}
    return config.bridge.model_copy(update=update)


def _state_file(config: CompanionConfig) -> Path | None:
    folder = config.state_folder
    return folder and folder / "injection-gate.json"


def _inhibit_memory(config: CompanionConfig) -> InhibitMemory | None:
    """Memory of inhibitions for this map and camera; None without a state folder."""
    file = _state_file(config)
    if file is None:
        return None
    cameras = [one.model_dump(mode="json") for one in (config.camera, config.bridge.camera)]
    about = json.dumps([readable_map_hash(config.map), *cameras])  # escaped: paths may be no UTF-8
    digest = hashlib.sha256(about.encode()).hexdigest()
    return InhibitMemory(file.with_name("guardian-forbids.json"), about=digest)
