"""The bridge: one flight-controller link, an optional ground link, and what flows over them."""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import quaternion as quat
from mavlink_bridge.camera_component import CameraComponent
from mavlink_bridge.clock import SteadyUtc, monotonic_ns
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.errors import BridgeStateError
from mavlink_bridge.inject import NO_FIX_YET, Injection, InjectionContext, Injector
from mavlink_bridge.link import Link
from mavlink_bridge.messages import (
    Attitude,
    CameraView,
    GimbalAttitude,
    HealthLevel,
    Origin,
    TargetReport,
    TrackRequest,
    VehicleState,
    VisionFix,
)
from mavlink_bridge.origin import OriginKeeper
from mavlink_bridge.profile import FirmwareProfile, select_profile
from mavlink_bridge.recorder import TlogRecorder
from mavlink_bridge.signing import load_key
from mavlink_bridge.streams import StreamKeeper, wanted_streams
from mavlink_bridge.targets_out import cursor_on_target
from mavlink_bridge.transport import Endpoint, UdpTransport
from mavlink_bridge.vehicle import MESSAGES_IN, VehicleTracker

log = logging.getLogger(__name__)

_SECOND_NS = 1_000_000_000
_RC_FRESH_NS = _SECOND_NS
_QUEUE = 64
_TEXTS = 32
_TIMESYNC_PENDING = 8
_FIRST_GUESS = 1  # the system id that vehicles are delivered with

_SYSTEM_STATUS = {
    HealthLevel.STARTING: mavlink.MAV_STATE_BOOT,
    HealthLevel.OK: mavlink.MAV_STATE_ACTIVE,
    HealthLevel.DEGRADED: mavlink.MAV_STATE_CRITICAL,
    HealthLevel.FAILED: mavlink.MAV_STATE_EMERGENCY,
}
_SEVERITY = {
    HealthLevel.STARTING: mavlink.MAV_SEVERITY_INFO,
    HealthLevel.OK: mavlink.MAV_SEVERITY_INFO,
    HealthLevel.DEGRADED: mavlink.MAV_SEVERITY_WARNING,
    HealthLevel.FAILED: mavlink.MAV_SEVERITY_ERROR,
}
_COMMANDS_IN = ("COMMAND_LONG", "COMMAND_INT")


def _message_id(name: str) -> int:
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))


_FC_WANTED = frozenset(
    _message_id(name)
    for name in (*MESSAGES_IN, *_COMMANDS_IN, "TIMESYNC", "GPS_GLOBAL_ORIGIN", "COMMAND_ACK")
)
_GROUND_WANTED = frozenset(_message_id(name) for name in _COMMANDS_IN)


class Bridge:
    """Speaks MAVLink for the localizer. Every public method may be called from any thread.

    on_track: called (in a link's thread; must return at once) when the operator asks for tracking.
    """

    def __init__(
        self,
        config: BridgeConfig,
        geoid_separation_m: float,
        *,
        on_track: Callable[[TrackRequest], None] | None = None,
    ) -> None:
        self._config = config
        self._geoid_m = geoid_separation_m
        self._started = False
        self._begun_ns = monotonic_ns()
        self._utc = SteadyUtc()
        self._recorder = None if config.tlog is None else TlogRecorder(config.tlog)
        self._tracker = VehicleTracker(
            config.system_id, _mount(config), config.camera.mount == "fixed"
        )
        self._fc = _FlightControllerSide(self, on_track)
        self._fc_link = self._link(config.connection, self._fc, "fc", _FC_WANTED, config.signing)
        self._ground: _GroundSide | None = None
        self._ground_link: Link | None = None
        if config.ground_connection is not None:
            self._ground = _GroundSide(self, on_track)
            self._ground_link = self._link(
                config.ground_connection,
                self._ground,
                "ground",
                _GROUND_WANTED,
                config.ground_signing,
            )
        self._cot = _cot_socket(config.targets.cot_endpoint)
        self._health_lock = threading.Lock()
        self._health = (HealthLevel.STARTING, "")
        self._texts: deque[tuple[int, str]] = deque(maxlen=_TEXTS)

    def _link(self, connection: str, handler: Any, name: str, wanted: Any, key: Any) -> Link:
        return Link(
            Endpoint.parse(connection),
            handler,
            name=name,
            wanted=wanted,
            signing_key=None if key is None else load_key(key.key_file),
            signing_link_id=1 if key is None else key.link_id,
            recorder=self._recorder,
            timeout_s=self._config.link_timeout_s,
        )

    # --- life -----------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the links and keep them open."""
        if self._started:
            raise BridgeStateError("the bridge was already started; make a new one")
        self._started = True
        self._fc_link.start()
        if self._ground_link is not None:
            self._ground_link.start()

    def stop(self) -> None:
        """Close the links; the bridge cannot be started again."""
        self._fc_link.stop()
        if self._ground_link is not None:
            self._ground_link.stop()
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
        """Hand over a fix; never blocks."""
        self._fc.fixes.append(fix)
        self._fc_link.wake()

    def report(self, target: TargetReport) -> None:
        """Report a target to the ground; never blocks."""
        self._to_ground(target)
        if self._cot is not None:
            try:
                self._cot.write(cursor_on_target(target, self._config.targets, self._utc))
            except OSError as error:
                log.debug("Cursor-on-Target not sent: %s", error)

    def look(self, view: CameraView) -> None:
        """Tell the ground where the camera looks (CAMERA_FOV_STATUS); never blocks."""
        self._to_ground(view)

    def _to_ground(self, item: TargetReport | CameraView) -> None:
        side = self._fc if self._ground is None else self._ground
        link = self._fc_link if self._ground_link is None else self._ground_link
        side.outbound.append(item)
        link.wake()

    def set_health(self, level: HealthLevel, text: str = "") -> None:
        """The localizer's health; a change of level or text is told to the operator once."""
        with self._health_lock:
            if (level, text) == self._health:
                return
            self._health = (level, text)
        self.say(_SEVERITY[level], f"PiLoT: {text or level.value}")

    def say(self, severity: int, text: str) -> None:
        """A line for the operator: STATUSTEXT on the ground side, and the log."""
        self._texts.append((severity, text))
        log.log(logging.WARNING if severity <= mavlink.MAV_SEVERITY_WARNING else logging.INFO, text)
        message = mavlink.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:50])
        link = self._fc_link if self._ground_link is None else self._ground_link
        link.send(message, self._config.companion_component)

    # --- out ------------------------------------------------------------------------------------

    def state(self) -> VehicleState:
        """What the vehicle says about itself."""
        return self._tracker.snapshot(monotonic_ns())

    def attitude_at(self, time_ns: int) -> Attitude | None:
        """The vehicle's attitude at a CLOCK_MONOTONIC time; None when the buffer has none."""
        return self._tracker.attitude_at(time_ns)

    def gimbal_at(self, time_ns: int) -> GimbalAttitude | None:
        """The camera's attitude to NED at a time: gimbal or body, and mounting."""
        return self._tracker.gimbal_at(time_ns)

    def texts(self) -> list[str]:
        """The last lines told to the operator, oldest first."""
        return [text for _, text in self._texts]

    @property
    def injecting(self) -> bool:
        """Whether fixes are sent to the flight controller right now (mode and RC gate)."""
        return self._fc.mode(self.state(), monotonic_ns()) == "inject"

    def counters(self) -> dict[str, int | float | str]:
        """Counters of links and injection; keys are prefixed by where they come from."""
        result: dict[str, int | float | str] = {}
        result.update({f"fc_{k}": v for k, v in self._fc_link.stats().items()})
        if self._ground_link is not None:
            result.update({f"ground_{k}": v for k, v in self._ground_link.stats().items()})
        result.update({f"inject_{k}": v for k, v in self._fc.injector.counters.items()})
        result.update({f"bridge_{k}": v for k, v in self._fc.counters.items()})
        result["inject_reason"] = self._fc.injector.reason
        result["reset_counter"] = self._fc.injector.reset_counter
        result["yaw_difference_deg"] = math.degrees(self._fc.injector.yaw_difference_rad)
        result["clock_round_trip_ms"] = (self._tracker.clock.round_trip_ns or 0) * 1e-6
        return result

    def uptime_ms(self, now_ns: int) -> int:
        """Milliseconds since the bridge began: its own time_boot_ms."""
        return (now_ns - self._begun_ns) // 1_000_000 & 0xFFFFFFFF


class _Side:
    """What both ends share: heartbeats, the camera component, the queue towards the ground."""

    def __init__(
        self, bridge: Bridge, on_track: Callable[[TrackRequest], None] | None, *, ground: bool
    ) -> None:
        self.bridge = bridge
        self.config = bridge._config
        self.tracker = bridge._tracker
        self.outbound: deque[TargetReport | CameraView] = deque(maxlen=_QUEUE)
        self.camera = CameraComponent(self.config, bridge._geoid_m, on_track, ground_link=ground)
        self._next_heartbeat_ns = 0

    def on_open(self, link: Link) -> None:
        """Announce at once."""
        self._next_heartbeat_ns = 0

    def heartbeat(self, link: Link, now_ns: int) -> None:
        """HEARTBEAT of each component at 1 Hz; system status follows the localizer's health."""
        if now_ns < self._next_heartbeat_ns:
            return
        self._next_heartbeat_ns = now_ns + _SECOND_NS
        status = _SYSTEM_STATUS[self.bridge._health[0]]
        onboard = mavlink.MAV_TYPE_ONBOARD_CONTROLLER
        components = [
            (self.config.companion_component, onboard),
            (self.config.localizer_component, onboard),
        ]
        if self.config.camera.announce:
            components.append((self.config.camera_component, mavlink.MAV_TYPE_CAMERA))
        for component, kind in components:
            message = mavlink.MAVLink_heartbeat_message(
                kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, status, 3
            )
            link.send(message, component)

    def serve_camera(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Targets and camera pose to the ground."""
        while self.outbound:
            item = self.outbound.popleft()
            if isinstance(item, TargetReport):
                self.camera.report(item)
            else:
                self.camera.look(item)
        position = None
        if math.isfinite(state.latitude_deg):
            position = Origin(state.latitude_deg, state.longitude_deg, state.altitude_amsl_m)
        self.camera.tick(now_ns, position, self.bridge.uptime_ms(now_ns), link.send)

    def camera_command(self, link: Link, message: Any, time_ns: int) -> None:
        """A command that may be for the camera."""
        if self.config.camera.announce and message.target_system in (0, link.system_id):
            self.camera.command(message, time_ns, self.bridge.uptime_ms(time_ns), link.send)


class _GroundSide(_Side):
    """The separate ground link: telemetry bandwidth is not spent on injection there."""

    def __init__(self, bridge: Bridge, on_track: Callable[[TrackRequest], None] | None) -> None:
        super().__init__(bridge, on_track, ground=True)

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Commands for the camera."""
        if message.get_type() in _COMMANDS_IN:
            self.camera_command(link, message, time_ns)

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Heartbeats and targets, once the vehicle's system id is known."""
        state = self.tracker.snapshot(now_ns)
        link.system_id = self.config.system_id or state.system_id or 0
        if link.system_id:
            self.heartbeat(link, now_ns)
            if self.config.camera.announce:
                self.serve_camera(link, state, now_ns)
        return now_ns + 20_000_000


class _FlightControllerSide(_Side):
    """The flight controller's link: identity, clock, streams, origin, injection."""

    def __init__(self, bridge: Bridge, on_track: Callable[[TrackRequest], None] | None) -> None:
        super().__init__(bridge, on_track, ground=False)
        self.fixes: deque[VisionFix] = deque(maxlen=_QUEUE)
        self.counters: Counter[str] = Counter()
        self.injector = Injector(self.config.injection, bridge._geoid_m, bridge._utc)
        self.origin = OriginKeeper(self.config.origin)
        self.streams = StreamKeeper()
        self._sync_sent: dict[int, int] = {}
        self._next_sync_ns = 0
        self._next_version_ns = 0
        self._connected = False
        self._reason = NO_FIX_YET
        self._profile_told = ""

    # --- messages in ----------------------------------------------------------------------------

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """One message from the flight controller's link (also from others, routed by it)."""
        kind = message.get_type()
        if kind in _COMMANDS_IN:
            self.camera_command(link, message, time_ns)
            return
        if not self.tracker.accepts(message):
            return
        self.streams.seen(kind, time_ns)
        if kind == "TIMESYNC":
            self._timesync(link, message, time_ns)
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._origin(message)
        elif kind == "COMMAND_ACK":
            self._ack(message)
        elif self.tracker.handle(message, time_ns):
            self._rebooted()

    def _timesync(self, link: Link, message: Any, time_ns: int) -> None:
        if message.tc1 == 0:
            answer = mavlink.MAVLink_timesync_message(monotonic_ns(), message.ts1)
            link.send(answer, self.config.companion_component)
            return
        sent_ns = self._sync_sent.pop(message.ts1, None)
        if sent_ns is not None:
            self.tracker.clock.timesync(message.tc1, sent_ns, time_ns)

    def _origin(self, message: Any) -> None:
        news = self.origin.on_origin(message)
        self.tracker.set_origin(self.origin.origin)
        if news is not None:
            self.bridge.say(mavlink.MAV_SEVERITY_INFO, f"PiLoT: {news}")

    def _ack(self, message: Any) -> None:
        if message.result not in (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS):
            self.counters["commands_refused"] += 1

    def _rebooted(self) -> None:
        self.counters["reboots"] += 1
        self.origin.reset()
        self.tracker.set_origin(None)
        self.injector.guard.reset()
        self.streams.reset()
        self.bridge.say(mavlink.MAV_SEVERITY_WARNING, "PiLoT: flight controller rebooted")

    # --- the clockwork --------------------------------------------------------------------------

    def on_open(self, link: Link) -> None:
        """Ask for everything again."""
        super().on_open(link)
        self.streams.reset()
        self._next_sync_ns = 0
        self._sync_sent.clear()

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Everything that is due; returns when the next thing is."""
        state = self.tracker.snapshot(now_ns)
        link.system_id = self.config.system_id or state.system_id or 0
        self._watch(state)
        if not link.system_id and link.endpoint.kind == "udpout":
            # Behind UDP an autopilot answers whoever spoke first, so somebody has to.
            link.system_id = _FIRST_GUESS
        if link.system_id:
            self.heartbeat(link, now_ns)
        if state.connected:
            self._ask(link, state, now_ns)
            self._sync(link, now_ns)
            self._keep_origin(link, now_ns)
            if self.bridge._ground is None and self.config.camera.announce:
                self.serve_camera(link, state, now_ns)
        return self._inject(link, state, now_ns)

    def _watch(self, state: VehicleState) -> None:
        if state.connected != self._connected:
            self._connected = state.connected
            if state.connected:
                self.streams.reset()
                log.info("flight controller found: system %s", state.system_id)
            else:
                self.counters["lost"] += 1
                log.warning("flight controller lost: no heartbeat for 3 s")

    def _ask(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Streams that do not flow, and the firmware's version."""
        for stream in self.streams.due(wanted_streams(self.config, state.autopilot), now_ns):
            interval_us = round(1e6 / stream.rate_hz)
            self._command(
                link, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, stream.message_id, interval_us
            )
        if state.version is None and now_ns >= self._next_version_ns:
            self._next_version_ns = now_ns + _SECOND_NS
            self._command(
                link, mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
            )

    def _command(self, link: Link, command: int, *parameters: float) -> None:
        padded = [*parameters, *([0.0] * (7 - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *padded
        )
        link.send(message, self.config.companion_component)

    def _sync(self, link: Link, now_ns: int) -> None:
        if now_ns < self._next_sync_ns:
            return
        self._next_sync_ns = now_ns + _SECOND_NS
        while len(self._sync_sent) >= _TIMESYNC_PENDING:
            del self._sync_sent[next(iter(self._sync_sent))]
        sent_ns = monotonic_ns()
        self._sync_sent[sent_ns] = sent_ns
        link.send(mavlink.MAVLink_timesync_message(0, sent_ns), self.config.companion_component)

    def _keep_origin(self, link: Link, now_ns: int) -> None:
        def ask(message_id: int) -> None:
            self._command(link, mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)

        message = self.origin.tick(now_ns, link.system_id, ask)
        if message is not None and self.config.mode in ("inject", "rc"):
            self.counters["origins_sent"] += 1
            link.send(message, self.config.companion_component)

    # --- injection ------------------------------------------------------------------------------

    def mode(self, state: VehicleState, now_ns: int) -> str:
        """off, shadow or inject; mode rc follows its channel, and no channel means shadow."""
        if self.config.mode != "rc":
            return self.config.mode
        gate = self.config.rc
        channels = state.rc_channels_us
        fresh = now_ns - state.rc_time_ns < _RC_FRESH_NS and len(channels) >= gate.channel
        if fresh and gate.inject_above_us <= channels[gate.channel - 1] <= 2200:
            return "inject"
        return "shadow"

    def profile(self, state: VehicleState) -> FirmwareProfile:
        """The firmware's profile; an unknown one is told once."""
        profile = select_profile(state.autopilot, state.version)
        if not profile.known and state.connected and self._profile_told != profile.name:
            self._profile_told = profile.name
            self.bridge.say(
                mavlink.MAV_SEVERITY_WARNING, "PiLoT: unknown firmware, using the safe profile"
            )
        return profile

    def _inject(self, link: Link, state: VehicleState, now_ns: int) -> int:
        while self.fixes:
            self.injector.submit(self.fixes.popleft(), now_ns)
        mode = self.mode(state, now_ns)
        if mode == "off" or not state.connected:
            return now_ns + 100_000_000
        context = InjectionContext(
            self.origin.origin, self.profile(state), self.tracker.attitude_at
        )
        injection = self.injector.step(now_ns, context)
        if injection is not None:
            self._deliver(link, mode, injection)
        self._tell(self.injector.reason)
        return self.injector.next_due_ns(now_ns)

    def _deliver(self, link: Link, mode: str, injection: Injection) -> None:
        if mode != "inject":
            self.counters["shadowed"] += 1
        elif link.send(injection.message, self.config.localizer_component):
            self.counters["injected"] += 1

    def _tell(self, reason: str) -> None:
        """Why nothing is sent, when that changes (digits aside, or it would never stop)."""
        plain = "".join(c for c in reason if not c.isdigit() and c not in "+-.")
        if plain == self._reason:
            return
        self._reason = plain
        if reason:
            self.bridge.say(mavlink.MAV_SEVERITY_WARNING, f"PiLoT: not sent: {reason}")
        else:
            self.bridge.say(mavlink.MAV_SEVERITY_INFO, "PiLoT: injecting")


def _mount(config: BridgeConfig) -> quat.Quaternion:
    camera = config.camera
    return quat.from_euler(
        math.radians(camera.mount_roll_deg),
        math.radians(camera.mount_pitch_deg),
        math.radians(camera.mount_yaw_deg),
    )


def _cot_socket(endpoint: str) -> UdpTransport | None:
    if not endpoint:
        return None
    where = Endpoint.parse(f"udpout:{endpoint}")
    return UdpTransport(None, (where.address, where.number))
