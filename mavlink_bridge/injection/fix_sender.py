"""Sends fixes, queued by any thread, as positions on the link, or reports why none is sent."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, cleared
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import CommandAnswer, Name
from mavlink_bridge.config import Mode
from mavlink_bridge.injection.encode import EncodedMessage, InjectionContext
from mavlink_bridge.injection.injector import Injector
from mavlink_bridge.injection.outcome import InjectionOutcome
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState, VisionFix
from mavlink_bridge.shared import Shared
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.origin_exchange import OriginExchange
from mavlink_bridge.vehicle.profile import FirmwareProfile, select_profile

_RELIEF_SHARE = 0.9  # of a limit, below which its warning ends
_DELAY_SLACK_MS = 10.0
_IN_TIME_S = 15.0  # until lateness is over; a computer at its limit is late and in time by turns


class FixWarnings:
    """Checks the injector and the computer's clock, and reports; one thread."""

    def __init__(self, shared: Shared, injector: Injector, notifier: StatusNotifier) -> None:
        self._config = shared.config.injection
        self._utc = shared.utc
        self._injector = injector
        self._notifier = notifier

    def check_firmware(self, state: VehicleState, profile: FirmwareProfile) -> None:
        """Report a known firmware without a profile, or without the configured message."""
        if not state.connected or state.version is None:
            return
        self._notifier.notify("profile", None if profile.known else alert(AlertId.UNKNOWN_FIRMWARE))
        sent = self._config.message
        taken = sent in profile.messages
        unsupported = (
            None if taken else alert(AlertId.MESSAGE_UNSUPPORTED, message=Name(sent.upper()))
        )
        self._notifier.notify("message", unsupported)

    def check_fixes(self, profile: FirmwareProfile, now_ns: int) -> None:
        """Report fixes that are late, not checked for yaw, or (GPS_INPUT) without a valid UTC."""
        tell = self._notifier.notify
        late = self._latency(profile)
        relief = alert(AlertId.FIXES_IN_TIME)
        self._notifier.notify_settled("latency", late, relief, now_ns, wait_s=_IN_TIME_S)
        blind = alert(AlertId.YAW_UNCHECKED) if self._injector.guard.blind else None
        tell("blind", blind, cleared(AlertId.YAW_UNCHECKED))
        unset = self._config.message == "gps_input" and not self._utc.is_set
        tell("utc", alert(AlertId.CLOCK_NOT_SET) if unset else None)

    def _latency(self, profile: FirmwareProfile) -> Alert | None:
        known = self._injector.latency
        latency, least = known.median_ms, known.least_ms
        if latency is None or least is None or not known.is_known:
            return None
        says_age = self._config.message == "external_position_estimate"
        limit_ms = profile.max_delay_ms if says_age else self._config.delay_ms
        # Where the firmware goes by the least lag, its positions lag by what that is late.
        lag = least if profile.least_lag else latency
        late = alert(AlertId.FIXES_LATE, age_ms=lag, limit_ms=limit_ms)
        over = alert(AlertId.FIXES_OVER_LIMIT, age_ms=latency, limit_ms=profile.max_delay_ms)
        reported = self._notifier.reported("latency")
        last = None if reported is None else reported.id
        is_over = last is AlertId.FIXES_OVER_LIMIT
        if latency > profile.max_delay_ms * (_RELIEF_SHARE if is_over else 1.0):
            return over
        limit = limit_ms + _DELAY_SLACK_MS
        if lag > limit:
            return late
        is_told = is_over or last is AlertId.FIXES_LATE
        if is_told and lag > _RELIEF_SHARE * limit:  # not yet over, but nothing new to report
            return over if is_over else late
        return None


_QUEUE = 64
_NEWS_AFTER_NS = 1_000_000_000  # a gap in the fixes that is reported
_BRIEF = (AlertId.NO_FRESH_FIX, AlertId.LINK_FULL)
_GOOD_NS = 1_000_000_000
_FED_NS = 10_000_000_000  # ArduPilot's receiver times out after 4 s, and the EKF reckons on
_ASK_NS = 1_000_000_000
_ANSWERED_NS = 2_000_000_000
_AIDING = mavlink.EKF_POS_HORIZ_ABS | mavlink.EKF_GPS_GLITCHING


class PositionCommand:
    """Tracks whether the autopilot accepts MAV_CMD_EXTERNAL_POSITION_ESTIMATE. answer: its last
    answer.

    An autopilot that fuses such positions accepts the command while its EKF uses GNSS. ArduPilot
    4.7 refuses it then. After the loss of GNSS it accepts the command, but only to reset the
    position: in a test the vehicle landed after 8 s although each fix was sent. An autopilot that
    has refused is not asked again until a reboot.
    """

    def __init__(self) -> None:
        self.answer = CommandAnswer.NOT_ASKED
        self._fuses: bool | None = None
        self._asked_ns = self._accepted_ns = 0
        self._held_ns = self._held_since_ns = 0  # fixes that were not sent

    def add_answer(self, result: int, now_ns: int) -> None:
        """Process the autopilot's MAV_RESULT to a sent command. The first answer decides whether
        the firmware fuses this command.
        """
        self.answer = CommandAnswer.of(result)
        is_accepted = result == mavlink.MAV_RESULT_ACCEPTED
        if self._fuses is None:
            self._fuses = is_accepted
        if is_accepted:
            self._accepted_ns = now_ns

    def is_accepted(self, now_ns: int) -> bool:
        """Whether the autopilot accepted the command in the last 2 s, so that each fix is sent."""
        return bool(self._fuses) and now_ns - self._accepted_ns < _ANSWERED_NS

    def should_ask(self, state: VehicleState, now_ns: int) -> bool:
        """Note that a fix is held. True, at most once a second: send it all the same as a test."""
        if now_ns - self._held_ns > _ASK_NS:
            self._held_since_ns = now_ns
        self._held_ns = now_ns
        if self._fuses is None:
            aided = state.ekf_flags & _AIDING == mavlink.EKF_POS_HORIZ_ABS
            may_ask = aided and gnss_healthy(state, now_ns)
        else:
            may_ask = self._fuses
        if not may_ask or now_ns - self._asked_ns < _ASK_NS:
            return False
        self._asked_ns = now_ns
        if self._fuses is None:
            self.answer = CommandAnswer.NOT_ANSWERED
        return True

    def is_held(self, now_ns: int) -> bool:
        """Whether fixes have been held (`should_ask`) for over 2 s, longer than an answer takes."""
        is_recent = now_ns - self._held_ns < _ASK_NS
        return is_recent and self._held_ns - self._held_since_ns > _ANSWERED_NS


class FixSender:
    """Sends queued fixes in the flight-controller link's thread; any thread may call `put`.

    vision: the last position that was sent or, in shadow mode, compared; None before the first.
    """

    def __init__(
        self,
        shared: Shared,
        origin: OriginExchange,
        outcome: InjectionOutcome,
        notifier: StatusNotifier,
        counters: Counter[str],
    ) -> None:
        self.dropped = 0
        """Fixes that the link's thread came too late for."""
        self._fixes: deque[VisionFix] = deque(maxlen=_QUEUE)
        self.injector = Injector(shared.config.injection, shared.geoid_separation_m, shared.utc)
        self.vision: PropagatedFix | None = None
        commands = shared.config.injection.message == "external_position_estimate"
        self._command = PositionCommand() if commands else None
        self._component = shared.config.localizer_component
        self._attitude_at = shared.tracker.attitude_at
        self._origin = origin
        self._outcome = outcome
        self._notifier = notifier
        self._counters = counters
        self._reason: Alert | None = None
        self._taken = True  # by the link, of the last position
        self._delivered_ns = 0
        self._sent_ns: int | None = None  # to the flight controller

    def put(self, fix: VisionFix) -> None:
        """Queue a fix; the oldest is dropped if the queue is full. Never blocks."""
        self.dropped += len(self._fixes) == _QUEUE
        self._fixes.append(fix)

    def drain_queue(self, now_ns: int) -> None:
        """Pass the fixes that were queued since the last call to the injector, oldest first."""
        while self._fixes:
            self.injector.submit(self._fixes.popleft(), now_ns)

    def acknowledged(self, link: Link, ack: Any, now_ns: int) -> None:
        """Process a COMMAND_ACK of EXTERNAL_POSITION_ESTIMATE. An ack for a ground station that
        also sends the command is ignored.
        """
        ours = ack.target_system in (0, link.system_id)
        if self._command is not None and ours and ack.target_component in (0, self._component):
            self._command.add_answer(ack.result, now_ns)

    def rebooted(self) -> None:
        """Reset the yaw guard and the position command's state: the autopilot rebooted."""
        self.injector.guard.reset()
        self._command = None if self._command is None else PositionCommand()

    def step(self, link: Link, state: VehicleState, mode: Mode, now_ns: int) -> None:
        """Make the message that is due; send it in mode ``inject``, in ``shadow`` only queue its
        position for the comparison with GNSS. Report why none is made or sent. mode: not ``off``.
        """
        profile = select_profile(state.autopilot, state.version)
        context = InjectionContext(self._origin.origin, profile, self._attitude_at, link.system_id)
        injection = self.injector.step(now_ns, context)
        if injection is not None:
            self.vision = injection.estimate.position
            self._deliver(link, state, mode, injection, now_ns)
        delta = self.injector.motion.take_message()
        if delta is not None and mode == "inject" and link.send(delta, self._component):
            self._counters["injected_deltas"] += 1
        reason = self.injector.reason
        command = self._command if mode == "inject" else None
        if reason is None and command is not None and not command.is_accepted(now_ns):
            reason = alert(AlertId.COMMAND_NOT_TAKEN, answer=command.answer)
        if reason is None and not self._taken:
            reason = alert(AlertId.LINK_FULL)
        self._reason = reason
        # A late fix or two is no news: the texts would follow every hiccup of a busy computer.
        recent = now_ns - self._delivered_ns < _NEWS_AFTER_NS
        of = None if reason is None else reason.id
        waits = of is AlertId.COMMAND_NOT_TAKEN and command and not command.is_held(now_ns)
        if of is not AlertId.NO_FIX_YET and not (recent and of in _BRIEF) and not waits:
            relief = alert(AlertId.INJECTING) if mode == "inject" else None
            self._notifier.notify_settled("inject", reason, relief, now_ns)

    def is_good(self, now_ns: int) -> bool:
        """Whether a position was sent (in shadow mode: computed) in the last second, and the yaw
        guard does not block.
        """
        return not self.injector.guard.blocked and now_ns - self._delivered_ns < _GOOD_NS

    def reaches_ekf(self, now_ns: int) -> bool:
        """Whether a position was sent to the flight controller in the last second: not in shadow
        mode, while output is held, or while the port is full.
        """
        return self._sent_ns is not None and now_ns - self._sent_ns < _GOOD_NS

    def may_feed_ekf(self, now_ns: int) -> bool:
        """Whether a position was sent in the last 10 s: the EKF's state may depend on it."""
        return self._sent_ns is not None and now_ns - self._sent_ns < _FED_NS

    @property
    def refusal(self) -> Alert | None:
        """Why due positions are not sent, once this has been reported; else None."""
        reported = self._notifier.reported("inject")
        is_told = reported is not None and reported.id is not AlertId.INJECTING
        return self._reason if is_told else None

    def _deliver(
        self, link: Link, state: VehicleState, mode: Mode, injection: EncodedMessage, now_ns: int
    ) -> None:
        self._outcome.add_computed(injection.estimate)
        if self._command is not None and mode == "inject":
            if not injection.estimate.fresh:
                return  # it has its age with it: nothing is propagated
            if not self._command.is_accepted(now_ns):
                if self._command.should_ask(state, now_ns):
                    self._counters["position_commands"] += 1
                    link.send(injection.message, self._component)
                return
        # What a port that is full does not take, the EKF does not have: no source to switch to.
        self._taken = mode != "inject" or link.send(injection.message, self._component)
        if not self._taken:
            return
        self._delivered_ns = now_ns
        if mode != "inject":
            self._counters["shadowed"] += 1
            return
        self._counters["injected"] += 1
        if self._sent_ns is None and injection.estimate.reset_counter:
            # A process that died had counted as far: the autopilot sees a jump with the next one.
            self.injector.announce_jump()
        self._sent_ns = now_ns
        self._outcome.add_sent(injection.estimate, now_ns)
