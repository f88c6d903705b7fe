"""The companion process: every part wired once, started and stopped in order.

Data flows one way: feed -> engine -> (bridge, targets, recorder). Each consumer only puts the
estimate into its own queue on the localization thread.
"""

from __future__ import annotations

import gc
import logging
import sys
import threading
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from companion.config import CompanionConfig, RecordConfig
from companion.errors import ConfigError, DiskFaultError
from companion.flight.conversions import camera_rotation, vehicle_prior, vision_fix
from companion.flight.detections import Detection, DetectionListener
from companion.flight.health import HealthMonitor
from companion.flight.recorder import Recorder, fresh_folder, remove_empty, write_manifest
from companion.flight.target_reporter import Target, TargetReporter
from companion.flight.view_reporter import ViewReporter
from companion.preflight.coverage import check_origin
from companion.sources import StreamState, open_source
from localizer.geometry.pose import Array
from localizer.map.cache.cache import TileCache
from localizer.map.cache.surface import MapSurface
from localizer.tracking.engine import DualThreadEngine
from localizer.tracking.opening import MapStack, build_localizer
from localizer.types import PoseEstimate, PosePrior, ReferenceBundle, TrackingState
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import TargetReport, TrackRequest

_log = logging.getLogger(__name__)
# How long a thread may keep the interpreter from another that woke up. Python's 5 ms, several times
# between an estimate and the autopilot, would be 7 ms in the median (benchmarks.bridge).
_SWITCH_S = 0.0002
_CLICK_NS = 2_000_000_000  # how old the pose may be that an operator's click is placed by
_WARNING = 4  # MAV_SEVERITY_WARNING; lower is worse


class Companion:
    """One deployment. `run` blocks until `stop` is called or the feed ends."""

    def __init__(self, config: CompanionConfig) -> None:
        self._config = config
        self._feed_ended = threading.Event()
        self._is_stopping = False
        self._is_up = False
        self._record_folder: Path | None = None
        self._is_recorded = True

    def run(self) -> None:
        """Fly until stopped. Raises what ended the feed, after everything is shut down.

        Whatever fails on the way up, what was already up is shut down: a part's thread that stayed
        behind would keep the process from ending.
        """
        sys.setswitchinterval(_SWITCH_S)
        with ExitStack() as up:
            try:
                self._build(self._config, up)
                # What the imports and compilers left is never garbage: searching it for garbage
                # would stop every thread for a tenth of a second now and then.
                gc.collect()
                gc.freeze()
                self._is_up = True
            except BaseException:
                up.close()
                self.discard_record()
                raise
            self._start(up)
            # In slices: signals are handled between them.
            while not (self._is_stopping or self._feed_ended.wait(0.2)):
                pass
        if self._feed_error is not None:
            raise self._feed_error

    def stop(self) -> bool:
        """End `run` in order, soon. False on the way up, which goes on.

        For a signal handler: it takes no lock, since what it interrupts may hold that one.
        """
        self._is_stopping = True
        return self._is_up

    def discard_record(self) -> None:
        """Remove the record of a start that comes to nothing. It may be at any of its steps."""
        if self._record_folder is not None:
            remove_empty(self._record_folder)

    def _build(self, config: CompanionConfig, up: ExitStack) -> None:
        self._camera = config.camera.model.camera()
        self._lever_arm = np.array(config.camera.lever_arm_m)
        self._stack = MapStack(config.map, config.localizer)
        up.callback(self._stack.close)
        _require_origin_at_map(config, self._stack.cache)
        manifest = self._stack.cache.manifest
        self._frame = self._stack.cache.frame
        self._geoid_separation_m = manifest.geoid_separation_m
        self._newest: PoseEstimate | None = None
        self._recorder: Recorder | None = None
        self._bridge = Bridge(
            _bridge_config(config),
            manifest.geoid_separation_m,
            on_track=self._on_track,
            on_text=self._on_text,
        )
        up.callback(self._bridge.stop)  # of one that was never started: it has files open
        record = config.record
        if record is not None:
            record = self._open_record(record, up)
        # Before the localizer, whose compilation takes its time: a wrong source, or a port in use,
        # is told at once.
        self._source = open_source(
            config.camera.source, self._camera, config.camera.settings, self._on_feed_state
        )
        surface = MapSurface(self._stack.cache)
        self._targets = TargetReporter(config.targets, surface.cast, self._on_target)
        if config.targets.detections is not None:
            listener = DetectionListener(config.targets.detections, self._targets.add_detection)
            up.callback(listener.close)
        _log.info("making the localizer ready; the first start on a machine compiles its kernels")
        localizer = build_localizer(self._stack, self._camera, config.localizer, self._rotation_at)
        self._engine = DualThreadEngine(localizer, (self._on_estimate,), self._vehicle_prior)
        self._view = ViewReporter(
            config.bridge.targets.rate_hz, self._frame, surface.cast, self._bridge.look
        )
        self._health = HealthMonitor(
            self._engine,
            self._bridge,
            lambda: self._source.state,
            self._event,
            record,
            lambda: self._is_recorded,
        )
        self._was_tracking = False
        self._click_refused_ns = 0
        self._target_numbers: dict[str, int] = {}
        self._feed_error: Exception | None = None

    def _open_record(self, record: RecordConfig, up: ExitStack) -> RecordConfig | None:
        """The record that is written, in a folder of its own; None while the disk takes none: this
        may be a restart in the air.
        """
        try:
            record = record.model_copy(update={"folder": fresh_folder(record.folder)})
            self._record_folder = record.folder
            self._recorder = Recorder(record, self._frame, self._record_failed)
            up.callback(self._recorder.close)
            write_manifest(record.folder, self._config)
        except DiskFaultError as error:
            self._record_failed(str(error.__cause__))
            return None if self._recorder is None else record
        return record

    def _start(self, up: ExitStack) -> None:
        """Start every part; `up` stops them in the reverse order, the feed first."""
        self._bridge.start()
        up.callback(self._bridge.stop)  # before the record closes, which holds what is told
        self._health.start()
        up.callback(self._health.stop)
        self._targets.start()
        up.callback(self._targets.stop)
        if self._config.bridge.camera.announce:
            self._view.start()
            up.callback(self._view.stop)
        self._engine.start()
        up.callback(self._engine.stop)
        feeder = threading.Thread(target=self._feed, name="feed")
        feeder.start()
        up.callback(feeder.join)
        up.callback(self._source.close)
        self._event("info", f"map {self._config.map}, feed {self._config.camera.source}")
        self._event("info", f"renderer {self._stack.renderer.name}")

    def _feed(self) -> None:
        try:
            for frame in self._source.frames():
                self._engine.submit(frame)
                if self._recorder is not None:
                    self._recorder.snapshot(frame)
        except Exception as error:
            self._feed_error = error
        self._feed_ended.set()

    def _on_feed_state(self, state: StreamState, text: str) -> None:
        bad = state in (
            StreamState.STALLED, StreamState.FAILED, StreamState.SCALED, StreamState.MISFIT
        )  # fmt: skip
        self._event("warning" if bad else "info", f"feed: {text}")

    def _vehicle_prior(self, time_ns: int) -> PosePrior | None:
        sigma = self._config.prior
        return vehicle_prior(
            self._bridge.state(),
            self._bridge.attitude_at(time_ns),
            self._bridge.gimbal_at(time_ns),
            self._frame,
            self._geoid_separation_m,
            self._lever_arm,
            (sigma.position_sigma_m, float(np.radians(sigma.rotation_sigma_deg))),
            time_ns,
        )

    def _rotation_at(self, time_ns: int) -> Array | None:
        """The camera's rotation in the map's axes by the autopilot's attitude and gimbal."""
        gimbal = self._bridge.gimbal_at(time_ns)
        return camera_rotation(gimbal) if gimbal is not None else None

    def _on_estimate(self, estimate: PoseEstimate, _: ReferenceBundle) -> None:
        if self._recorder is not None:
            self._recorder.estimate(estimate)
        self._targets.add_estimate(estimate)
        self._view.add_estimate(estimate)
        if estimate.accepted:
            self._newest = estimate
        self._health.add_estimate(estimate)
        tracking = estimate.state is TrackingState.TRACKING
        if estimate.accepted and tracking:
            self._inject(estimate, reset=not self._was_tracking)
        # DEGRADED keeps the filter's track: only a new start after LOST may carry a jump.
        if tracking or estimate.state is TrackingState.LOST:
            self._was_tracking = tracking

    def _on_track(self, request: TrackRequest) -> None:
        """The ground station's click: the place under that pixel of the newest localized frame."""
        newest = self._newest
        if request.kind == "stop":
            return
        if newest is None or request.time_ns - newest.exposure_time_ns > _CLICK_NS:
            # The operator points into the present picture; an old pose would place it elsewhere.
            if request.time_ns - self._click_refused_ns > _CLICK_NS:
                self._click_refused_ns = request.time_ns
                self._bridge.say(_WARNING, "PiLoT: no target: the camera's position is not known")
            return
        x, y = np.array(request.coordinates).reshape(-1, 2).mean(axis=0)
        u, v = x * newest.camera.width, y * newest.camera.height
        detection = Detection("ground station", newest.exposure_time_ns, float(u), float(v))
        self._targets.add_detection(detection)

    def _inject(self, estimate: PoseEstimate, reset: bool) -> None:
        time_ns = estimate.exposure_time_ns
        self._bridge.submit(
            vision_fix(
                estimate,
                self._frame,
                self._bridge.attitude_at(time_ns),
                self._bridge.gimbal_at(time_ns),
                self._lever_arm,
                reset,
            )
        )

    def _on_target(self, target: Target) -> None:
        fix = target.fix
        if self._recorder is not None:
            self._recorder.target(fix, target.velocity)
        position = self._frame.position(fix.position_world)
        east, north, up = target.velocity
        camera = target.estimate.camera
        self._bridge.report(
            TargetReport(
                time_ns=fix.exposure_time_ns,
                latitude_deg=position.latitude_deg,
                longitude_deg=position.longitude_deg,
                height_m=position.height_m,
                velocity_ned=(float(north), float(east), float(-up)),
                h_accuracy_m=float(np.sqrt(fix.covariance[0, 0] + fix.covariance[1, 1])),
                v_accuracy_m=float(np.sqrt(fix.covariance[2, 2])),
                pixel=(fix.pixel[0] / camera.width, fix.pixel[1] / camera.height),
                target_id=self._target_number(fix.target_id),
                elsewhere=fix.elsewhere,
            )
        )

    def _target_number(self, name: str) -> int:
        """A small stable number for a target's name, as MAVLink wants it."""
        return self._target_numbers.setdefault(name, len(self._target_numbers))

    def _record_failed(self, why: str) -> None:
        self._is_recorded = False
        self._bridge.say(_WARNING, f"PiLoT: record is incomplete: {why}")

    def _on_text(self, severity: int, text: str) -> None:
        """What the operator was told belongs in the record; the bridge has logged it."""
        if self._recorder is not None:
            self._recorder.event("warning" if severity <= _WARNING else "info", text)

    def _event(self, level: str, text: str) -> None:
        _log.log(logging.WARNING if level == "warning" else logging.INFO, "%s", text)
        if self._recorder is not None:
            self._recorder.event(level, text)


def _require_origin_at_map(config: CompanionConfig, cache: TileCache) -> None:
    """The vehicle keeps an origin until it is switched off: a wrong one must never be sent."""
    if config.bridge.origin is not None:
        finding = check_origin(config.bridge.origin, cache)
        if not finding.ok:
            raise ConfigError(f"bridge.origin: {finding.found} (needed {finding.needed})")


def _bridge_config(config: CompanionConfig) -> BridgeConfig:
    """The bridge announces the camera that the feed really has."""
    camera = config.camera.model.camera()
    announced = config.bridge.camera.model_copy(
        update={
            "width_px": camera.width,
            "height_px": camera.height,
            "horizontal_fov_deg": camera.horizontal_fov_deg,
        }
    )
    return config.bridge.model_copy(update={"camera": announced})
