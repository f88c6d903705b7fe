"""The flight controller's side of the bridge: dispatches messages and sends what is due."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert, Inhibits
from mavlink_bridge.alerts.catalogue import CATALOGUE, alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.camera.look_at import LOOKS
from mavlink_bridge.components import COMMANDS_IN, Components
from mavlink_bridge.config import WITHOUT_SOURCE_SET, Mode
from mavlink_bridge.injection.fix_sender import FixSender, FixWarnings
from mavlink_bridge.injection.outcome import InjectionOutcome
from mavlink_bridge.injection.shadow import ShadowInterlock, ShadowScore
from mavlink_bridge.injection.switching import SourceSwitch
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import Figures, VehicleState
from mavlink_bridge.place_hint import PLACE_HINT
from mavlink_bridge.shared import Shared
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.commands import Commander, is_accepted
from mavlink_bridge.vehicle.mission import MISSION_IN, MissionWatch
from mavlink_bridge.vehicle.origin_exchange import OriginExchange
from mavlink_bridge.vehicle.profile import select_profile
from mavlink_bridge.vehicle.readings import MESSAGES_IN
from mavlink_bridge.vehicle.streams import StreamKeeper
from mavlink_bridge.vehicle.timesync import TimeSync
from mavlink_bridge.vehicle_events import UnexpectedSenderMonitor, VehicleEvents

_FIRST_GUESS = 1  # the system id that vehicles are delivered with
_IDLE_NS = 100_000_000


def message_id(name: str) -> int:
    """MAVLink message id of a message name."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))


FC_WANTED = frozenset(
    message_id(name)
    for name in (
        *MESSAGES_IN,
        *COMMANDS_IN,
        *MISSION_IN,
        "TIMESYNC",
        "GPS_GLOBAL_ORIGIN",
        "COMMAND_ACK",
        "STATUSTEXT",
    )
)


class FlightControllerEnd:
    """Handles the flight controller's link, in its thread. Other threads call only `sender.put`,
    `inhibit`, `clear`, and what reads its state.

    Above 200 lines: it passes each message and each clock tick to one of a dozen components.
    """

    def __init__(self, shared: Shared) -> None:
        config = shared.config
        self.counters: Counter[str] = Counter()
        self.components = Components(shared, ground=False)
        self._shared = shared
        self._tracker = shared.tracker
        self._notifier = notifier = StatusNotifier(shared.report, {"inject": None, "loop": None})
        self._commander = commander = Commander(config.companion_component)
        self._streams = StreamKeeper(config, commander)
        self.mission = MissionWatch(config.companion_component)
        self.time_sync = TimeSync(
            shared.tracker, config.companion_component, notifier, shared.clock
        )
        self.origin = OriginExchange(config, shared.tracker, commander, notifier, self.counters)
        self.outcome = InjectionOutcome(shared, self.origin, notifier, self.counters)
        self.sender = FixSender(shared, self.origin, self.outcome, notifier, self.counters)
        self.sources = SourceSwitch(config.switch, commander, notifier, self.counters)
        self.interlock = ShadowInterlock(
            config, self.shadow_score, lambda: self.outcome.compared_ns, notifier
        )
        self.news = VehicleEvents(notifier)
        self._warnings = FixWarnings(shared, self.sender.injector, notifier)
        self._strangers = UnexpectedSenderMonitor(config, shared.tracker, notifier, self.counters)
        self._next_check_ns = 0
        self._connected = False
        self._mode: Mode = "off"

    def shadow_score(self, now_ns: int) -> ShadowScore:
        """Comparison of vision with GNSS over the two minutes before now_ns."""
        return self.outcome.shadow.score(now_ns, self.sender.injector.guard.refused_rad)

    def on_gnss(self, now_ns: int) -> bool | None:
        """Whether the EKF takes its position from GNSS; None if its source set is unknown. Fixes
        may also feed the EKF beside GNSS or as its receiver (by the configured message; on PX4,
        which has no source sets, always). Then the answer is False if the set is unknown, or if a
        fix was sent in the last 10 s.
        """
        current = self.sources.current
        unswitched = ("gps_input", *WITHOUT_SOURCE_SET)
        is_px4 = self._shared.tracker.snapshot(now_ns).autopilot == "px4"
        beside = is_px4 or self._shared.config.injection.message in unswitched
        if beside and (current is None or self.sender.may_feed_ekf(now_ns)):
            return False
        return None if current is None else self.sources.on_gnss

    def inhibit(self, of: AlertId) -> None:
        """Prevent what the alert inhibits from starting, until `clear`."""
        if Inhibits.INJECTION in CATALOGUE[of].inhibits:
            self.interlock.inhibited_by |= {of}
        if Inhibits.EKF_OK in CATALOGUE[of].inhibits:
            self.outcome.ekf_ok_inhibited_by |= {of}

    def clear(self, of: AlertId) -> None:
        """End the inhibition by this alert."""
        self.interlock.inhibited_by -= {of}
        self.outcome.ekf_ok_inhibited_by -= {of}

    @property
    def injecting(self) -> bool:
        """Whether mode, pilot's enable and shadow check let fixes be sent."""
        return self._mode == self._shared.mode() == "inject"

    @property
    def injection_fault(self) -> Alert | None:
        """Alert, as reported, if positions are not sent or the EKF does not follow. None otherwise,
        and in modes other than ``inject``.
        """
        if not self.injecting:
            return None
        verdict = self.outcome.verdict
        return self.sender.refusal or (verdict.reason if verdict is not None else None)

    def figures(self) -> Figures:
        """Counters and measurements for a record, None where unknown; the prefix of a key names its
        source.
        """
        injector, clock = self.sender.injector, self._tracker.clock
        result: Figures = {}
        result.update({f"inject_{k}": v for k, v in dict(injector.counters).items()})
        result.update({f"bridge_{k}": v for k, v in dict(self.counters).items()})
        result.update({f"rx_{k}": v for k, v in dict(self._streams.counts).items()})
        result["inject_reason"] = "" if injector.reason is None else injector.reason.id.value
        result["reset_counter"] = injector.reset_counter
        yaw = injector.guard.difference_rad
        result["yaw_difference_deg"] = None if yaw is None else math.degrees(yaw)
        result["fix_latency_ms"] = injector.latency.median_ms
        trip = clock.round_trip_ns
        result["clock_round_trip_ms"] = None if trip is None else trip * 1e-6
        result["clock_rate"] = clock.rate
        result["clock_steps"] = clock.steps
        result["ignored_messages"] = self._tracker.ignored
        result["fixes_not_taken"] = self.sender.dropped
        return result

    # --- messages in ----------------------------------------------------------------------------

    def on_message(self, link: Link, message: Any, time_ns: int) -> None:
        """Process a message of the vehicle, a command routed to us, or a heartbeat of others."""
        kind = message.get_type()
        if kind in COMMANDS_IN:
            self.components.command(link, message, time_ns)
            return
        if not self._tracker.accepts(message):
            self._strangers.on_message(link, message)
            return
        self._streams.on_message(kind, time_ns)
        if kind == "HEARTBEAT":
            link.keep_peer()
        if kind == "TIMESYNC":
            if self.time_sync.on_message(link, message, time_ns):
                self._rebooted()
        elif kind == "GPS_GLOBAL_ORIGIN":
            self.origin.on_message(message, time_ns)
        elif kind in MISSION_IN:
            self.mission.on_message(link, message, time_ns)
        elif kind == "COMMAND_ACK":
            self._acknowledged(link, message, time_ns)
        elif self._tracker.handle(message, time_ns):
            self._rebooted()
        elif kind == "STATUSTEXT":
            if not getattr(message, "chunk_seq", 0):  # a longer text's middle begins anyhow
                self.sources.on_text(str(message.text))
        elif kind == "RC_CHANNELS" and self._shared.enable is not None:
            self._shared.enable.on_rc_channels(self._tracker.snapshot(time_ns).rc_channels_us)

    def _acknowledged(self, link: Link, message: Any, now_ns: int) -> None:
        if message.command == PLACE_HINT:
            self.sender.acknowledged(link, message, now_ns)
            return
        if not self._commander.is_ours(link, message):
            return
        if not is_accepted(message):
            self.counters["commands_refused"] += 1
        if message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            self.sources.acknowledged(is_accepted(message))
        elif message.command in LOOKS:
            self._shared.look.answered(message.result)

    def _rebooted(self) -> None:
        self.counters["reboots"] += 1
        self.origin.forget()
        self.sender.rebooted()
        self.sources.rebooted()
        self._request_all()
        self._notifier.report(alert(AlertId.FC_REBOOTED))

    def _request_all(self) -> None:
        """Request everything again, because the link was opened or the vehicle is back."""
        self._streams.reset()
        self.mission.reset()

    # --- the clockwork --------------------------------------------------------------------------

    def on_open(self, link: Link) -> None:
        """Announce our components at once, and request everything again."""
        self.components.announce()
        self._request_all()
        self.time_sync.reset()

    def on_tick(self, link: Link, now_ns: int) -> int:
        """Do everything that is due; returns the time of the next, CLOCK_MONOTONIC ns."""
        config = self._shared.config
        state = self._tracker.snapshot(now_ns)
        link.system_id = config.system_id or state.system_id or 0
        self._watch(state)
        if not link.system_id and (link.endpoint.kind == "udpout" or config.signing):
            # Behind UDP an autopilot answers whoever spoke first. A signing one that does not know
            # the time signs with an old stamp until it has heard a newer one. So we speak first.
            link.system_id = _FIRST_GUESS
        due_ns = self._inject(link, state, now_ns)  # before anything that can wait
        if link.system_id:
            self.components.heartbeat(link, now_ns)
        if state.connected:
            self.mission.tick(link, state, now_ns)
            self._streams.tick(link, state, now_ns)
            self.time_sync.tick(link, now_ns)
            self.origin.tick(link, now_ns, may_set=self.injecting)
            look = self._shared.look.due(now_ns)
            if look is not None:
                self._commander.send_int(link, look[0], look[1], look[2:])
            if config.ground_connection is None and config.camera.announce:
                self.components.serve_camera(link, state, now_ns)
        return due_ns

    def _watch(self, state: VehicleState) -> None:
        self._shared.watch.check(state)
        if state.connected == self._connected:
            return
        self._connected = state.connected
        if state.connected:
            self._request_all()
            self.sources.on_first_message(state)
        else:
            self.counters["lost"] += 1
            # It may come back as another: after a reboot, with another origin.
            self.origin.forget()

    def _inject(self, link: Link, state: VehicleState, now_ns: int) -> int:
        sender = self.sender
        sender.drain_queue(now_ns)
        shared = self._shared
        mode = self._mode = self.interlock.mode(
            shared.mode(), state, now_ns, by_pilot=shared.enable is not None
        )
        if mode == "off" or not state.connected:
            sender.injector.clear()
            return now_ns + _IDLE_NS
        profile = select_profile(state.autopilot, state.version)
        self._warnings.check_firmware(state, profile)
        sender.step(link, state, mode, now_ns)
        if now_ns >= self._next_check_ns:
            self._next_check_ns = now_ns + _IDLE_NS
            self._check(link, state, now_ns)
            self._warnings.check_fixes(profile, now_ns)
        return sender.injector.next_due_ns(now_ns)

    def _check(self, link: Link, state: VehicleState, now_ns: int) -> None:
        """Check the effect of the sent positions ten times a second: score, verdict,
        source switch.
        """
        sender = self.sender
        self.outcome.compare(state, now_ns, on_gnss=self.on_gnss(now_ns))
        self._strangers.check(link, now_ns)
        if self.outcome.check_ekf(state, now_ns):
            sender.injector.announce_jump()
        came = sender.is_good(now_ns)
        may_switch = self.interlock.may_switch(now_ns)
        good = came and self.injecting
        may_inject = self._shared.mode() == "inject"
        # A set that is not known is ordered, so that it is; shadow mode orders nothing.
        if may_inject or self.sources.current is not None:
            self.sources.tick(
                link, state, sender.vision, good=good, may_switch=may_switch, now_ns=now_ns
            )
        held = came and may_inject
        self.news.set_hold_reason(self.interlock.reason if held else None, now_ns)
        self.news.update(state, now_ns, injecting=good, refused=self.sources.gnss_refused)
