"""The bridge: one flight-controller link, an optional ground link, and the messages on them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Name
from mavlink_bridge.camera.cursor_on_target import CursorOnTarget
from mavlink_bridge.camera.look_at import LookAt
from mavlink_bridge.components import COMMANDS_IN, Components, GroundEnd
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import BridgeStateError
from mavlink_bridge.flight_controller import FC_WANTED, FlightControllerEnd, message_id
from mavlink_bridge.injection.injection_enable import InjectionEnable
from mavlink_bridge.injection.outcome import LoopVerdict
from mavlink_bridge.injection.restart_memory import InjectionEnableMemory
from mavlink_bridge.injection.shadow import ShadowScore, gnss_healthy
from mavlink_bridge.link.clock import SteadyUtc, monotonic_ns
from mavlink_bridge.link.link import Link, LinkHandler, LinkOptions
from mavlink_bridge.link.tlog import TlogRecorder
from mavlink_bridge.link.transport import Endpoint, parse_sender
from mavlink_bridge.messages import (
    Attitude,
    CameraView,
    Figures,
    GimbalAttitude,
    HealthLevel,
    InertialSample,
    PlaceHint,
    TargetEnd,
    TargetReport,
    TrackRequest,
    VehicleState,
    VisionFix,
)
from mavlink_bridge.shared import Shared
from mavlink_bridge.status import OperatorStatus, StatusNotifier, named_values
from mavlink_bridge.vehicle.mission import MissionWaypoint
from mavlink_bridge.vehicle.tracker import VehicleTracker
from mavlink_bridge.vehicle_events import VehicleWatch

_GROUND_WANTED = frozenset(message_id(name) for name in ("HEARTBEAT", *COMMANDS_IN))
_WARNING = 4  # MAV_SEVERITY; lower is worse
_AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1
_NEXT_STATION_S = 10.0  # a second ground station takes over where the first one fell silent


class Bridge:
    """The localizer's MAVLink interface. Every public method may be called from any thread.

    Above 200 lines and 15 public methods: it is the package's whole interface, and each method
    passes one call to the component that does the work.

    on_track: called in a link's thread when the operator asks for tracking; it must return at once.
    on_hint: called likewise when the operator gives the vehicle's position; returns whether it can
    be used. on_alert: called likewise with every alert for the operator. clock: CLOCK_MONOTONIC,
    ns; for a recorded flight, which uses `play` and `tick` in place of `start`, the time in the
    record. Raises errors of `mavlink_bridge.errors` for keys, files and endpoints that cannot be
    used.
    """

    def __init__(
        self,
        config: BridgeConfig,
        geoid_separation_m: float,
        *,
        on_track: Callable[[TrackRequest], None] | None = None,
        on_hint: Callable[[PlaceHint], bool] | None = None,
        on_alert: Callable[[Alert], None] = lambda _alert: None,
        clock: Callable[[], int] = monotonic_ns,
    ) -> None:
        self._config, self._clock = config, clock
        self._started = self._stopped = False
        self._utc = SteadyUtc()
        self._status = OperatorStatus(self._send_text, on_alert, clock)
        notifier = StatusNotifier(self.report_alert)
        self._recorder = None
        if config.tlog is not None:

            def incomplete(why: str) -> None:
                notifier.report(alert(AlertId.TLOG_INCOMPLETE, why=Name(why)))

            self._recorder = TlogRecorder(config.tlog, incomplete)
        self._tracker = VehicleTracker(config)
        enable = _enable(config, notifier)
        self._shared = shared = Shared(
            config,
            geoid_separation_m,
            self._utc,
            self._tracker,
            self._clock(),
            lambda: self._status.level,
            self.report_alert,
            on_track,
            on_hint,
            VehicleWatch(
                self.report_alert, enable.announce if enable is not None else lambda: None, clock
            ),
            enable,
            LookAt(config, geoid_separation_m, self.report_alert),
            clock,
        )
        self._fc = FlightControllerEnd(shared)
        self._fc_link = _link(config, config.connection, self._fc, "fc", self._recorder)
        # Without a ground link of its own, what is for the ground is routed by the autopilot.
        self._ground: Components = self._fc.components
        self._ground_link = self._fc_link
        if config.ground_connection is not None:
            ground = GroundEnd(shared)
            self._ground = ground.components
            self._ground_link = _link(
                config, config.ground_connection, ground, "ground", self._recorder
            )
        self._links = tuple(dict.fromkeys((self._fc_link, self._ground_link)))
        self._cot = None
        if config.targets.cot_endpoint:
            self._cot = CursorOnTarget(config.targets, config.camera, self._utc)

    # --- life -----------------------------------------------------------------------------------

    def set_map_id(self, map_id: str) -> None:
        """Before `start`, set the id of the map. A stored failure of the shadow check over another
        map is ignored.
        """
        self._fc.interlock.set_map_id(map_id)

    def start(self) -> None:
        """Open the links and restore a killed process's state; `BridgeStateError` if repeated."""
        if self._started:
            raise BridgeStateError("the bridge was already started; make a new one")
        self._started = True
        if self._recorder is not None:
            self._recorder.start()
        if self._shared.enable is not None:
            self._shared.enable.recall()  # before a link finds the vehicle and has it announced
        self._fc.interlock.recall()
        for link in self._links:
            link.start()

    def play(self, message: Any) -> None:
        """Process a recorded message of the flight controller at the clock's time,
        without `start`.
        """
        self._fc.on_message(self._fc_link, message, self._clock())

    def tick(self) -> None:
        """Do what is due at the clock's time, as the link's thread does after `start`."""
        self._fc.on_tick(self._fc_link, self._clock())

    def hand_over(self) -> None:
        """Call before `stop` if another process takes over: the state for a restart is kept."""
        if self._shared.enable is not None:
            self._shared.enable.stop(clean_shutdown=False)
        self._fc.interlock.end(clean_shutdown=False)

    def stop(self) -> None:
        """Close links, sockets and the .tlog, and delete the state for a restart (see `hand_over`).
        The bridge cannot be started again. Harmless when called again.
        """
        if self._stopped:
            return
        self._stopped = True
        if self._shared.enable is not None:
            self._shared.enable.stop()
        for link in self._links:
            link.stop()
        self._fc.interlock.end()
        if self._cot is not None:
            self._cot.close()
        if self._recorder is not None:
            self._recorder.close()

    def __enter__(self) -> Bridge:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    # --- in -------------------------------------------------------------------------------------

    def submit(self, fix: VisionFix) -> None:
        """Queue a fix, to be sent or (shadow mode) only compared with GNSS by the link's thread.
        Never blocks; if 64 fixes wait, the oldest is dropped.
        """
        self._fc.sender.put(fix)
        self._fc_link.wake()

    def report(self, target: TargetReport) -> None:
        """Report a target to the ground station, and as Cursor-on-Target if `cot_endpoint` is set.
        A gimbal that looks at it follows. Blocks only to resolve the name in `cot_endpoint`.
        """
        self._to_ground(target)
        self._shared.look.report(target)
        if self._cot is not None:
            self._cot.send(target)

    def forget(self, target_id: int) -> None:
        """Stop reporting this target; a gimbal that looks at it stays. Never blocks."""
        self._to_ground(TargetEnd(target_id))
        self._shared.look.forget(target_id)

    def track(self, request: TrackRequest) -> None:
        """Pass a track request on to `on_track`, in this thread, as if a ground station had sent
        it. A new target gets the next number in place of the request's.
        """
        if request.kind != "stop":
            request = replace(request, number=next(self._shared.target_numbers))
        if self._shared.on_track is not None:
            self._shared.on_track(request)

    def inhibit(self, of: AlertId) -> None:
        """Prevent what the alert inhibits (`Inhibits`) from starting, until `clear`. Injection that
        runs goes on. The pilot's command (mode ``rc``) starts injection all the same, and
        `injection.force` also the switch to vision.
        """
        self._fc.inhibit(of)

    def clear(self, of: AlertId) -> None:
        """End the inhibition by this alert."""
        self._fc.clear(of)

    def report_view(self, view: CameraView) -> None:
        """Report the camera's view to the ground station (CAMERA_FOV_STATUS), and the aircraft as
        Cursor-on-Target if `cot_aircraft` is set. Blocks only as `report` does.
        """
        if self._config.camera.announce:
            self._to_ground(view)
        if self._cot is not None:
            self._cot.report_view(view)

    def _to_ground(self, item: TargetReport | TargetEnd | CameraView) -> None:
        self._ground.queue_item(item)
        self._ground_link.wake()

    def set_health(
        self, level: HealthLevel, alerts: Sequence[Alert] = (), *, tell: bool = True
    ) -> None:
        """Set the localizer's health and all active alerts, most severe first; new ones are sent.
        To be called every second, also without a change. tell: False if another component has sent
        the new ones already.
        """
        self._status.set_health(level, alerts, tell=tell)

    def report_alert(self, alert: Alert) -> None:
        """Report an alert to the operator: STATUSTEXT to the ground station, the log and
        `on_alert`. Ignored if it equals the last alert and follows within a second.
        """
        self._status.report(alert)

    def send_named_values(self, figures: Mapping[str, float]) -> None:
        """Send NAMED_VALUE_FLOAT for each value, if the setting `named_values` is on; never blocks.
        figures: value by name of 1 to 10 characters, else ValueError.
        """
        if self._config.named_values:
            uptime_ms = self._shared.uptime_ms(self._clock())
            for message in named_values(figures, uptime_ms):
                self._ground_link.send(message, self._config.companion_component)

    def _send_text(self, severity: int, message: Any) -> None:
        component = self._config.companion_component
        if self._config.texts_as_autopilot and severity <= _WARNING:
            component = self.state().component_id or _AUTOPILOT
        self._ground_link.send(message, component)

    # --- out ------------------------------------------------------------------------------------

    def state(self) -> VehicleState:
        """Newest state of the vehicle."""
        return self._tracker.snapshot(self._clock())

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a CLOCK_MONOTONIC time of the last seconds, else None."""
        return self._tracker.attitude_at(time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a CLOCK_MONOTONIC time: of the gimbal (of the vehicle, if
        the camera is fixed), turned by the configured mounting. None if unknown.
        """
        return self._tracker.gimbal_at(time_ns)

    def zoom_at(self, time_ns: int, hold_s: float) -> float | None:
        """The camera's reported zoom at a CLOCK_MONOTONIC time, per cent of its range; None:
        unknown. hold_s: how long a report stays valid.
        """
        return self._tracker.zoom_at(time_ns, hold_s)

    def local_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's north, east, down from its origin, m, at a CLOCK_MONOTONIC time; or None."""
        return self._tracker.local_at(time_ns)

    def gnss_place_at(self, time_ns: int) -> tuple[float, ...] | None:
        """The EKF's (latitude, longitude in degrees, altitude AMSL in m) at a CLOCK_MONOTONIC time;
        None unless the EKF uses GNSS now, and GNSS is healthy.
        """
        if not self.on_gnss or not gnss_healthy(self.state(), self._clock()):
            return None
        return self._tracker.global_at(time_ns)

    @property
    def on_gnss(self) -> bool | None:
        """Whether the EKF uses GNSS, healthy or not, by its source set; None if the set is unknown.
        False also if our positions may be in it: they are its receiver, or fused beside GNSS.
        """
        return self._fc.on_gnss(self._clock())

    def inertial_since(self, time_ns: int) -> tuple[InertialSample, ...]:
        """The newest IMU samples (512 at most) after a CLOCK_MONOTONIC time, oldest first."""
        return self._tracker.inertial_since(time_ns)

    def mission(self) -> tuple[MissionWaypoint, ...]:
        """Positions of the vehicle's mission; () until they are known. The first call starts the
        download, in the link's thread; a changed mission is downloaded again.
        """
        self._fc.mission.wanted = True
        return self._fc.mission.waypoints

    def alerts(self) -> list[Alert]:
        """The last 64 alerts that were reported, oldest first; also those that have ended."""
        return self._status.alerts()

    def last_ticks_ns(self) -> dict[str, int]:
        """When the threads "link fc" and "link ground" (if any) last ran, CLOCK_MONOTONIC ns."""
        return {f"link {link.name}": link.last_tick_ns for link in self._links}

    @property
    def port(self) -> int | None:
        """The local UDP port of the flight controller's link; None while it has none.

        With ``udpin:HOST:0`` the system chooses it, and the vehicle must be told.
        """
        return self._fc_link.port

    @property
    def injecting(self) -> bool:
        """Whether mode, pilot's enable and shadow check let fixes be sent; `reaches_ekf` tells
        whether any are.
        """
        return self._fc.injecting

    @property
    def reaches_ekf(self) -> bool:
        """Whether positions went to the flight controller in the last second."""
        return self._fc.sender.reaches_ekf(self._clock())

    @property
    def injection_fault(self) -> Alert | None:
        """Alert, reported already, if `injecting`, and positions are not sent or the EKF does not
        follow them; None otherwise.
        """
        return self._fc.injection_fault

    def shadow_score(self) -> ShadowScore:
        """Comparison of vision with GNSS over the last two minutes, where GNSS was healthy."""
        return self._fc.shadow_score(self._clock())

    def loop_verdict(self) -> LoopVerdict | None:
        """Whether the EKF follows the sent positions; None while nothing is sent or it is too
        early.
        """
        return self._fc.outcome.verdict

    def counters(self) -> Figures:
        """Counters, measurements and texts of links and injection, None where unknown. The prefix
        of most keys names the source: the link's name, `inject`, `bridge` or `rx`.
        """
        result: Figures = {}
        for link in self._links:
            result.update({f"{link.name}_{k}": v for k, v in link.stats().items()})
        result.update(self._fc.figures())
        result["tlog_dropped"] = 0 if self._recorder is None else self._recorder.dropped
        result["ekf_source_set"] = self._fc.sources.current
        return result


def _link(
    config: BridgeConfig,
    connection: str,
    handler: LinkHandler,
    name: str,
    recorder: TlogRecorder | None,
) -> Link:
    """The link to the autopilot ("fc") or to the ground ("ground")."""
    is_fc = name == "fc"
    signing = config.signing if is_fc else config.ground_signing
    options = LinkOptions(
        name=name,
        wanted=FC_WANTED if is_fc else _GROUND_WANTED,
        signing=signing,
        remembers=True,
        sender=parse_sender(config.sender) if is_fc and config.sender else None,
        # A signature says more of who speaks than an address does.
        follow_hosts_after_s=None if is_fc and signing is None else _NEXT_STATION_S,
        recorder=recorder,
        timeout_s=config.link_timeout_s,
    )
    return Link(Endpoint.parse(connection), handler, options)


def _enable(config: BridgeConfig, notifier: StatusNotifier) -> InjectionEnable | None:
    if config.mode != "rc":
        return None
    file = config.state_file
    memory = None if file is None else InjectionEnableMemory(file)
    return InjectionEnable(config.rc, notifier.report, memory)
