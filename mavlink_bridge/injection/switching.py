"""Decides when to change the EKF's source set: quickly away from bad GNSS, slowly back.

Measured: if the set is changed before GNSS fails, the vehicle moves at most 1.2 m; with a jammed
receiver and no change, ArduPilot lands after 4.6 s with up to 87 m of error. If GNSS and vision
contradict each other, the EKF decides: its inertial navigation rejects a receiver that jumps, and
keeps one from which a wrong map differs.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert, cleared, spec_of
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import ChosenSet, GnssProblem, ReturnCause, SwitchRefusal
from mavlink_bridge.config import SourceSwitchConfig
from mavlink_bridge.gnss_return import GnssReturnCheck
from mavlink_bridge.injection.propagate import PropagatedFix
from mavlink_bridge.injection.shadow import gnss_healthy
from mavlink_bridge.link.link import Link
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.status import StatusNotifier
from mavlink_bridge.vehicle.commands import Commander
from mavlink_bridge.vehicle.origin import north_east
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_RETRY_NS = 1_000_000_000
_SPEED_SLACK_S = 0.4  # a receiver's report is this much older than its time of arrival
_VISION_FRESH_NS = 1_000_000_000
_LARGEST_SIGMA_M = 5.0  # a receiver that claims to be bad must not hide an error in its claim
_VISION_GONE_NS = 3_000_000_000
_GNSS_BACK_NS = 3_000_000_000  # ArduPilot's failsafe comes 8 s after the last position
_RETURN_M = 25.0  # of GNSS from where the EKF has come by itself
_AGAIN_NS = 10_000_000_000
# ArduPilot's word where a switch of the transmitter, a script or the bridge chose the set.
_CHOSEN = re.compile(r"Using EKF Source Set ([1-3])\b")


@dataclass(frozen=True)
class SwitchOrder:
    """Select a source set (MAV_CMD_SET_EKF_SOURCE_SET), and why. metres: GNSS from vision, or 0."""

    source_set: int
    cause: GnssProblem | ReturnCause
    metres: float = 0.0

    @property
    def alert(self) -> Alert:
        """Alert that tells the operator about the order."""
        return Alert(AlertId.SOURCE_SET_SELECTED, (self.source_set, self.cause, self.metres))


_Place = tuple[float, float]  # latitude and longitude, degrees


def _receiver(state: VehicleState) -> _Place | None:
    if state.gps_latitude_deg is None or state.gps_longitude_deg is None:
        return None
    return state.gps_latitude_deg, state.gps_longitude_deg


def _ekf(state: VehicleState) -> _Place | None:
    if state.latitude_deg is None or state.longitude_deg is None:
        return None
    return state.latitude_deg, state.longitude_deg


def _distance_m(a: _Place, b: _Place) -> float:
    """Horizontal distance, m."""
    return math.hypot(*north_east(*a, *b))


def _inconsistent_m(state: VehicleState, vision: PropagatedFix | None, sigmas: float) -> float:
    """Distance of GNSS from vision, m, if above `sigmas` of both errors, otherwise 0."""
    receiver = _receiver(state)
    if vision is None or receiver is None:
        return 0.0
    apart = _distance_m(receiver, (vision.latitude_deg, vision.longitude_deg))
    accuracy = VEHICLE_SENSORS.gnss_sigma_m(state.gps_h_accuracy_m, _LARGEST_SIGMA_M)
    speed = math.hypot(*vision.velocity_ned[:2])
    limit = sigmas * math.hypot(accuracy, vision.horizontal_sigma_m) + speed * _SPEED_SLACK_S
    return apart if apart > limit else 0.0


def _ekf_is_with_vision(state: VehicleState, vision: PropagatedFix) -> bool:
    """Whether the EKF, which uses GNSS, is nearer to vision than to the receiver's position."""
    receiver, ekf = _receiver(state), _ekf(state)
    if receiver is None or ekf is None:
        return False
    place = (vision.latitude_deg, vision.longitude_deg)
    return _distance_m(place, ekf) < _distance_m(receiver, ekf)


@dataclass(frozen=True)
class GnssFault:
    """What is wrong with GNSS. proven: evidence other than vision shows it. metres: distance from
    vision if that is the cause, otherwise 0.
    """

    cause: GnssProblem
    proven: bool
    metres: float = 0.0

    @property
    def is_of_receiver(self) -> bool:
        """Whether GNSS alone shows the fault, without vision."""
        return not self.metres


def gnss_fault(
    state: VehicleState, vision: PropagatedFix | None, sigmas: float, now_ns: int
) -> GnssFault | None:
    """Why GNSS is bad: lost, glitching, or farther from vision than both errors allow; None if
    good. vision: newest position, None: not compared. sigmas: how many of both errors a distance
    may have.
    """
    if not gnss_healthy(state, now_ns):
        return GnssFault(GnssProblem.LOST, proven=True)
    glitch = mavlink.EKF_GPS_GLITCHING if state.autopilot == "ardupilot" else 0
    if state.ekf_flags & glitch:
        return GnssFault(GnssProblem.GLITCH, proven=True)
    apart = _inconsistent_m(state, vision, sigmas)
    if vision is None or not apart:
        return None
    return GnssFault(GnssProblem.OFF_VISION, _ekf_is_with_vision(state, vision), apart)


class SourceSwitch:
    """Decides about the EKF's source set, orders it and reports that; one thread.

    current: the source set of the flight controller, by its acknowledgements and texts; the GNSS
    set until then (PX4, which has no sets: always); None if unknown.
    """

    def __init__(
        self,
        config: SourceSwitchConfig,
        commander: Commander,
        notifier: StatusNotifier,
        counters: Counter[str],
    ) -> None:
        self._config = config
        self._commander = commander
        self._notifier = notifier
        self._counters = counters
        self.current: int | None = config.gnss_set
        self._returning = GnssReturnCheck()
        self._bad_since_ns: int | None = None
        self._sound_since_ns: int | None = None
        self._vision_ns: int | None = None
        self._ordered: int | None = None
        self._was_chosen = self._overruled = self._has_met = False
        self._next_ns = 0
        self._refused_ns: int | None = None  # when it was reported that GNSS is refused
        self._held_ns = 0  # when it was reported that the set is kept

    @property
    def on_gnss(self) -> bool:
        """Whether the flight controller is known to use the GNSS set."""
        return self.current == self._config.gnss_set

    @property
    def gnss_refused(self) -> bool:
        """Whether a receiver with a fix is not used because it contradicts vision."""
        return self._returning.refusal is not None

    def on_first_message(self, state: VehicleState) -> None:
        """Process the vehicle's state at its first message; further calls do nothing. The set of an
        ArduPilot that is armed already is unknown, because this process may have been restarted,
        which is reported; a disarmed one uses its first.
        """
        if not self._has_met and state.armed and state.autopilot == "ardupilot":
            self.current = None
            self._notifier.report(alert(AlertId.SOURCE_SET_UNKNOWN))
        self._has_met = True

    def on_text(self, text: str) -> None:
        """Process a STATUSTEXT of the autopilot, which may name the source set in use. A set that
        we did not order is the pilot's choice. A chosen vision set stays; a chosen GNSS set stays
        until the present fault of GNSS ends.
        """
        told = _CHOSEN.match(text)
        if told is None or int(told[1]) in (self.current, self._ordered):
            return
        self.current, self._was_chosen = int(told[1]), True
        self._overruled = self._bad_since_ns is not None

    def rebooted(self) -> None:
        """Assume the GNSS set, because the flight controller rebooted and uses its first."""
        self.current, self._ordered = self._config.gnss_set, None
        self._bad_since_ns = self._sound_since_ns = None
        self._was_chosen = self._overruled = False
        self._notifier.forget("switch")

    def acknowledged(self, accepted: bool) -> None:
        """Process a COMMAND_ACK of an order (accepted or not); a refusal is reported."""
        ordered, self._ordered = self._ordered, None
        if ordered is None:
            return
        if accepted:
            self.current, self._was_chosen = ordered, False
        else:
            self._notifier.report(alert(AlertId.SOURCE_SET_REFUSED))

    def tick(
        self,
        link: Link,
        state: VehicleState,
        vision: PropagatedFix | None,
        *,
        good: bool,
        may_switch: bool,
        now_ns: int,
    ) -> None:
        """Send and report an order if one is due, and report why none is sent although GNSS is bad,
        and a receiver that contradicts vision. vision: last position, None if none. good: positions
        are being sent and pass the yaw guard. may_switch: the shadow check of this flight has
        passed.
        """
        fresh = vision is not None and now_ns - vision.time_ns < _VISION_FRESH_NS
        if self.on_gnss:
            self._returning.reset()
        else:
            self._returning.update(state, vision if fresh and good else None, now_ns)
        self._report_refused(now_ns)
        if not self._config.enabled:
            return
        fault = gnss_fault(
            state, vision if fresh else None, self._config.inconsistency_sigmas, now_ns
        )
        self._bad_since_ns = None if fault is None else self._bad_since_ns or now_ns
        self._overruled = self._overruled and fault is not None
        # Judged by GNSS alone: a contradiction with vision does not count once vision is gone.
        sound = fault is None or not fault.is_of_receiver
        self._sound_since_ns = (self._sound_since_ns or now_ns) if sound else None
        if self._vision_ns is None or (fresh and good):
            self._vision_ns = now_ns
        if now_ns < self._next_ns:
            return
        order = self._to_vision(now_ns, fault, fresh and good, may_switch) or self._to_gnss(
            now_ns, state, fault
        )
        if order is not None:
            self._next_ns = now_ns + _RETRY_NS
            self._ordered = order.source_set
            self._counters["source_switches"] += 1
            self._commander.send(link, mavlink.MAV_CMD_SET_EKF_SOURCE_SET, order.source_set)
            self._notifier.notify("switch", order.alert)

    def _to_vision(
        self, now_ns: int, fault: GnssFault | None, vision_good: bool, may_switch: bool
    ) -> SwitchOrder | None:
        if self.current == self._config.vision_set or fault is None:
            return None
        since = self._bad_since_ns
        if since is None or now_ns - since < self._config.bad_after_s * 1e9:
            return None
        why: ChosenSet | SwitchRefusal | None = None
        if self._overruled and self.current is not None:
            why = ChosenSet(self.current)
        elif not fault.proven:
            why = SwitchRefusal.EKF_WITH_GNSS
        elif not may_switch:
            why = SwitchRefusal.NOT_READY
        elif vision_good:
            return SwitchOrder(self._config.vision_set, fault.cause, fault.metres)
        if why is not None and now_ns - self._held_ns >= _AGAIN_NS:
            self._held_ns = now_ns  # again as long as it lasts: the operator decides
            values = (fault.cause, fault.metres, why)
            self._notifier.report(Alert(AlertId.SOURCE_SET_HELD, values))
        return None

    def _to_gnss(
        self, now_ns: int, state: VehicleState, fault: GnssFault | None
    ) -> SwitchOrder | None:
        if self.current not in (self._config.vision_set, None) or self._was_chosen:
            return None
        agrees = self._returning.accepted and fault is None
        if agrees and self._config.return_to_gnss and self.current is not None:
            return SwitchOrder(self._config.gnss_set, ReturnCause.GNSS_GOOD)
        if self._vision_ns is None or now_ns - self._vision_ns < _VISION_GONE_NS:
            return None
        since = self._sound_since_ns
        if since is None or now_ns - since < _GNSS_BACK_NS:
            return None
        # Without any position the vehicle lands after 8 s. A receiver that is not where the EKF
        # went by itself, or not where vision was while it could be asked, may be a wrong one.
        receiver, ekf = _receiver(state), _ekf(state)
        refused = self._returning.refusal is not None
        if refused or receiver is None or ekf is None or _distance_m(receiver, ekf) > _RETURN_M:
            return None
        return SwitchOrder(self._config.gnss_set, ReturnCause.VISION_LOST)

    def _report_refused(self, now_ns: int) -> None:
        returning, alerted_ns = self._returning, self._refused_ns
        again_ns = spec_of(AlertId.GNSS_REFUSED).repeat_s * 1e9
        if returning.refusal is not None:
            if alerted_ns is None or now_ns - alerted_ns >= again_ns:
                self._refused_ns, why = now_ns, returning.refusal
                self._notifier.report(alert(AlertId.GNSS_REFUSED, size=why.size, why=why.why))
        elif alerted_ns is not None:
            self._refused_ns = None
            if returning.accepted:
                self._notifier.report(cleared(AlertId.GNSS_REFUSED))
