"""The flight controller's link: identity, clock, streams, origin, injection, and its outcome."""

from __future__ import annotations

import logging
from collections import Counter, deque
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.injection.closed_loop import ClosedLoopCheck, LoopVerdict
from mavlink_bridge.injection.injector import (
    NO_FIX_YET,
    NO_FRESH_FIX,
    FixQueue,
    Injection,
    InjectionContext,
    Injector,
)
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import ShadowScorer, gnss_healthy
from mavlink_bridge.injection.switching import SourceSwitch
from mavlink_bridge.link.clock import monotonic_ns
from mavlink_bridge.link.link import Link
from mavlink_bridge.link_end import COMMANDS_IN, SECOND_NS, Shared, Side
from mavlink_bridge.messages import VehicleState, without_figures
from mavlink_bridge.vehicle.origin import OriginKeeper, north_east
from mavlink_bridge.vehicle.presence import TwinWatch
from mavlink_bridge.vehicle.profile import FirmwareProfile, select_profile
from mavlink_bridge.vehicle.streams import StreamKeeper, wanted_streams
from mavlink_bridge.vehicle.tracker import MESSAGES_IN

log = logging.getLogger(__name__)

_QUEUE = 64
_TIMESYNC_PENDING = 8
_FIRST_GUESS = 1  # the system id that vehicles are delivered with
_IDLE_NS = 100_000_000
_NEWS_AFTER_NS = 1_000_000_000  # a gap in the fixes that is told
_REFERENCE_WAIT_NS = 500_000_000
_VISION_GOOD_NS = SECOND_NS
_RELIEF_SHARE = 0.9  # of a limit, below which its warning ends
_DELAY_SLACK_MS = 10.0


def message_id(name: str) -> int:
    """The id of a MAVLink message."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))


FC_WANTED = frozenset(
    message_id(name)
    for name in (*MESSAGES_IN, *COMMANDS_IN, "TIMESYNC", "GPS_GLOBAL_ORIGIN", "COMMAND_ACK")
)


class FlightControllerSide(Side):
    """Runs in the flight-controller link's thread; only `fixes` is filled from outside."""

    def __init__(self, shared: Shared) -> None:
        super().__init__(shared, ground=False)
        self.fixes = FixQueue(_QUEUE)
        self.counters: Counter[str] = Counter()
        self.injector = Injector(self.config.injection, shared.geoid_separation_m, shared.utc)
        self.origin = OriginKeeper(self.config.origin)
        self.streams = StreamKeeper()
        self.shadow = ShadowScorer(shared.geoid_separation_m)
        self.loop = ClosedLoopCheck(self.config.injection.message)
        self.switch = SourceSwitch(self.config.switch)
        self.verdict: LoopVerdict | None = None
        self.vision: PropagatedFix | None = None
        self._to_compare: deque[PropagatedFix] = deque(maxlen=_QUEUE)
        self._sync_sent: dict[int, int] = {}
        self._next_sync_ns = 0
        self._next_version_ns = 0
        self._next_check_ns = 0
        self._delivered_ns = 0
        self._twins = TwinWatch()
        self._connected = False
        self._told: dict[str, str] = {"inject": "nothing yet"}

    # --- messages in ----------------------------------------------------------------------------

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """One message from the flight controller's link (also from others, routed by it)."""
        kind = message.get_type()
        if kind in COMMANDS_IN:
            self.command(link, message, time_ns)
            return
        if not self.tracker.accepts(message):
            self._stranger(link, message)
            return
        self.streams.seen(kind, time_ns)
        if kind == "HEARTBEAT":
            link.keep_peer()
        if kind == "TIMESYNC":
            self._timesync(link, message, time_ns)
        elif kind == "GPS_GLOBAL_ORIGIN":
            self._origin(message)
        elif kind == "COMMAND_ACK":
            self._ack(link, message)
        elif self.tracker.handle(message, time_ns):
            self._rebooted()
        elif kind == "RC_CHANNELS" and self.shared.gate is not None:
            self.shared.gate.channels(self.tracker.snapshot(time_ns).rc_channels_us)

    def _stranger(self, link: Link, message: Any) -> None:
        """Heartbeats that mean a wiring or a start by mistake: a second vehicle, a second us."""
        if message.get_type() != "HEARTBEAT" or not link.system_id:
            return
        system, component = message.get_srcSystem(), message.get_srcComponent()
        config = self.config
        ours = (config.localizer_component, config.companion_component, config.camera_component)
        if system == link.system_id and component in ours:
            self._tell("twin", f"another companion speaks as component {component}: stop one")
        elif system == link.system_id and self.tracker.is_autopilot(message):
            self.counters["other_autopilots"] += 1
            self._tell("twins", f"another autopilot is system {system}, too: give it another id")
        elif config.system_id is None and self.tracker.is_autopilot(message):
            self.counters["other_autopilots"] += 1
            self._tell(
                "others",
                f"autopilot {system} is heard, {link.system_id} is followed: set bridge.system_id",
            )

    def _timesync(self, link: Link, message: Any, time_ns: int) -> None:
        if message.tc1 == 0:
            answer = mavlink.MAVLink_timesync_message(monotonic_ns(), message.ts1)
            link.send(answer, self.config.companion_component)
            return
        sent_ns = self._sync_sent.pop(message.ts1, None)
        if sent_ns is not None and self.tracker.timesync(message.tc1, sent_ns, time_ns):
            self._rebooted()

    def _origin(self, message: Any) -> None:
        news = self.origin.on_origin(message)
        self.tracker.set_origin(self.origin.origin)
        if news is not None:
            self.shared.say(mavlink.MAV_SEVERITY_INFO, f"PiLoT: {news}")

    def _ack(self, link: Link, message: Any) -> None:
        # Extension fields, 0 from old firmware: an answer to somebody else's command is not ours.
        if message.target_system not in (0, link.system_id) or message.target_component not in (
            0,
            self.config.companion_component,
        ):
            return
        accepted = message.result in (
            mavlink.MAV_RESULT_ACCEPTED,
            mavlink.MAV_RESULT_IN_PROGRESS,
        )
        if not accepted:
            self.counters["commands_refused"] += 1
        if message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            self.switch.acknowledged(accepted)
            if not accepted:
                self.shared.say(mavlink.MAV_SEVERITY_WARNING, "PiLoT: source switch refused")

    def _rebooted(self) -> None:
        self.counters["reboots"] += 1
        self._forget_origin()
        self.injector.guard.reset()
        self.switch.reset()
        self._told.pop("switch", None)
        self.streams.reset()
        self.shared.say(mavlink.MAV_SEVERITY_WARNING, "PiLoT: flight controller rebooted")

    def _forget_origin(self) -> None:
        """Nothing is sent relative to an origin that may be another one by now."""
        self.origin.reset()
        self.tracker.set_origin(None)

    # --- the clockwork --------------------------------------------------------------------------

    def on_open(self, link: Link) -> None:
        """Ask for everything again."""
        super().on_open(link)
        self.streams.reset()
        self._next_sync_ns = self._next_version_ns = 0
        self._sync_sent.clear()

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Everything that is due; returns when the next thing is."""
        state = self.tracker.snapshot(now_ns)
        link.system_id = self.config.system_id or state.system_id or 0
        self._watch(state)
        if not link.system_id and (link.endpoint.kind == "udpout" or self.config.signing):
            # Behind UDP an autopilot answers whoever spoke first. A signing one that does not know
            # the time signs with an old stamp until it has heard a newer one. So we speak first.
            link.system_id = _FIRST_GUESS
        due_ns = self._inject(link, state, now_ns)  # before anything that can wait
        if link.system_id:
            self.heartbeat(link, now_ns)
        if state.connected:
            self._ask(link, state, now_ns)
            self._sync(link, now_ns)
            self._keep_origin(link, now_ns)
            if self.config.ground_connection is None and self.config.camera.announce:
                self.serve_camera(link, state, now_ns)
        return due_ns

    def _watch(self, state: VehicleState) -> None:
        self.shared.watch.check(state)
        if state.connected == self._connected:
            return
        self._connected = state.connected
        if state.connected:
            self.streams.reset()
            self._next_version_ns = 0
        else:
            self.counters["lost"] += 1
            # It may come back as another: after a reboot, with another origin.
            self._forget_origin()

    def _ask(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Streams that do not flow, and the firmware's version."""
        for stream in self.streams.due(wanted_streams(self.config, state.autopilot), now_ns):
            interval_us = round(1e6 / stream.rate_hz)
            self._command(
                link, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, stream.message_id, interval_us
            )
        if state.version is None and now_ns >= self._next_version_ns:
            self._next_version_ns = now_ns + SECOND_NS
            self._command(link, mavlink.MAV_CMD_REQUEST_MESSAGE, message_id("AUTOPILOT_VERSION"))

    def _command(self, link: Link, command: int, *parameters: float) -> None:
        padded = [*parameters, *([0.0] * (7 - len(parameters)))]
        message = mavlink.MAVLink_command_long_message(
            link.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *padded
        )
        link.send(message, self.config.companion_component)

    def _sync(self, link: Link, now_ns: int) -> None:
        if now_ns < self._next_sync_ns:
            return
        self._next_sync_ns = now_ns + SECOND_NS
        while len(self._sync_sent) >= _TIMESYNC_PENDING:
            del self._sync_sent[next(iter(self._sync_sent))]
        sent_ns = monotonic_ns()
        self._sync_sent[sent_ns] = sent_ns
        link.send(mavlink.MAVLink_timesync_message(0, sent_ns), self.config.companion_component)

    def _keep_origin(self, link: Link, now_ns: int) -> None:
        def ask(wanted: int) -> None:
            self._command(link, mavlink.MAV_CMD_REQUEST_MESSAGE, wanted)

        message = self.origin.tick(now_ns, link.system_id, ask)
        mode = self.mode()
        if message is not None and mode == "inject":
            self.counters["origins_sent"] += 1
            link.send(message, self.config.companion_component)

    # --- injection ------------------------------------------------------------------------------

    def mode(self) -> str:
        """off, shadow or inject; mode rc follows its gate."""
        if self.shared.gate is None:
            return self.config.mode
        return "inject" if self.shared.gate.open else "shadow"

    def profile(self, state: VehicleState) -> FirmwareProfile:
        """The firmware's profile; one that is unknown, or lacks the message, is told once."""
        profile = select_profile(state.autopilot, state.version)
        if state.connected and state.version is not None:
            problem = ""
            message = self.config.injection.message
            if not profile.known:
                problem = "unknown firmware, using the safe profile"
            elif message not in profile.messages:
                problem = f"{profile.name} does not take {message.upper()}"
            self._tell("profile", problem)
        return profile

    def _inject(self, link: Link, state: VehicleState, now_ns: int) -> int:
        for fix in self.fixes.take():
            self.injector.submit(fix, now_ns)
        mode = self.mode()
        if mode == "off" or not state.connected:
            self.injector.skip()
            return now_ns + _IDLE_NS
        context = InjectionContext(
            self.origin.origin, self.profile(state), self.tracker.attitude_at
        )
        injection = self.injector.step(now_ns, context)
        if injection is not None:
            self.vision = injection.estimate.position
            self._deliver(link, mode, injection, now_ns)
        reason = self.injector.reason
        # A late fix or two is no news: the texts would follow every hiccup of a busy computer.
        brief = reason == NO_FRESH_FIX and now_ns - self._delivered_ns < _NEWS_AFTER_NS
        if reason != NO_FIX_YET and not brief:
            problem = f"not sent: {reason}" if reason else ""
            self._tell("inject", problem, "injecting", prefix=mode)
        if now_ns >= self._next_check_ns:
            self._next_check_ns = now_ns + _IDLE_NS
            self._check(link, state, now_ns)
            self._warn(context.profile)
        return self.injector.next_due_ns(now_ns)

    def _deliver(self, link: Link, mode: str, injection: Injection, now_ns: int) -> None:
        position = injection.estimate.position
        self._delivered_ns = now_ns
        if injection.estimate.fresh:
            self._to_compare.append(position)
        if mode != "inject":
            self.counters["shadowed"] += 1
            return
        if not link.send(injection.message, self.config.localizer_component):
            return
        self.counters["injected"] += 1
        origin = self.origin.origin
        if origin is not None:
            north, east = north_east(
                origin.latitude_deg,
                origin.longitude_deg,
                position.latitude_deg,
                position.longitude_deg,
            )
            sigma = position.horizontal_sigma_m
            counter = injection.estimate.reset_counter
            self.loop.sent(position.time_ns, now_ns, north, east, sigma, counter)

    def _check(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """What came of it, ten times a second: score, verdict, source switch."""
        while self._to_compare and now_ns - self._to_compare[0].time_ns > _REFERENCE_WAIT_NS:
            fix = self._to_compare.popleft()
            reference = self.tracker.global_at(fix.time_ns)
            on_gnss = self.switch.current == self.config.switch.gnss_set
            if reference is not None and on_gnss and gnss_healthy(state, now_ns):
                self.shadow.compare(fix, reference)
        clock = self.tracker.clock
        if self._twins.two(now_ns, clock.strays + clock.reboots):
            self._tell("twins", f"two autopilots speak as system {link.system_id}: change one's id")
        self.verdict = self.loop.verdict(now_ns, state, self.tracker.local_at)
        if self.verdict is not None:
            self._tell("loop", self.verdict.reason, "the EKF follows")
        if self.loop.jump_missed():
            self.counters["jumps_repeated"] += 1
            self.injector.announce_jump()
            self.shared.say(
                mavlink.MAV_SEVERITY_NOTICE, "PiLoT: the EKF missed a jump: announced again"
            )
        good = not self.injector.guard.blocked and now_ns - self._delivered_ns < _VISION_GOOD_NS
        good = good and self.mode() == "inject"
        order = self.switch.decide(now_ns, state, self.vision, good)
        if order is not None:
            self.counters["source_switches"] += 1
            self._command(link, mavlink.MAV_CMD_SET_EKF_SOURCE_SET, order.source_set)
            # Set 2 for a reason and set 1 for another differ by more than digits.
            self._tell("switch", f"EKF source set {order.source_set}: {order.reason}")

    def _warn(self, profile: FirmwareProfile) -> None:
        """What is wrong with the fixes themselves, told once."""
        self._tell("latency", self._latency_problem(profile), "fixes are in time again")
        blind = "vision yaw is not checked: no attitude or no gimbal angles"
        self._tell("blind", blind if self.injector.guard.blind else "", "vision yaw is checked")
        gps = self.config.injection.message == "gps_input"
        unset = gps and not self.shared.utc.is_set
        problem = "this computer's clock is not set: GPS_INPUT carries no time"
        self._tell("utc", problem if unset else "")

    def _latency_problem(self, profile: FirmwareProfile) -> str:
        latency, delay = self.injector.latency_ms, self.config.injection.delay_ms
        if not self.injector.latency_is_known:
            return ""
        injection, name = self.config.injection, profile.delay_parameter
        if injection.message == "gps_input":
            name = profile.gps_delay_parameter.format(n=injection.gps_id + 1)
        told = self._told.get("latency", "")
        late = f"fixes are {latency:.0f} ms old: raise delay_ms ({delay:.0f}) and {name}"
        over = f"fixes are {latency:.0f} ms old, over the {profile.max_delay_ms:.0f} ms of {name}"
        over_is_told = told == without_figures(over)
        if latency > profile.max_delay_ms * (_RELIEF_SHARE if over_is_told else 1.0):
            return over
        limit = delay + _DELAY_SLACK_MS
        if latency > limit:
            return late
        if told and latency > _RELIEF_SHARE * limit:  # not yet over, but nothing new to say
            return over if over_is_told else late
        return ""

    def _tell(self, topic: str, problem: str, relief: str = "", *, prefix: str = "") -> None:
        """A problem when it begins or changes (digits aside, or it would never stop), and its end.

        prefix: part of what is compared, not of what is said.
        """
        plain = f"{prefix if not problem else ''}{without_figures(problem)}"
        if plain == self._told.get(topic, ""):
            return
        known = topic in self._told
        self._told[topic] = plain
        if problem:
            self.shared.say(mavlink.MAV_SEVERITY_WARNING, f"PiLoT: {problem}")
        elif relief and known and prefix in ("", "inject"):
            self.shared.say(mavlink.MAV_SEVERITY_INFO, f"PiLoT: {relief}")
