"""Checks before a flight: parameters for the configured injection, link, clock, streams."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from mavlink_bridge.bridge import Bridge
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.link.clock import SteadyUtc, monotonic_ns
from mavlink_bridge.link.link import sleep_until
from mavlink_bridge.messages import Figures, GimbalAttitude, VehicleState
from mavlink_bridge.preflight.client import ParameterClient
from mavlink_bridge.preflight.failsafes import (
    PARAMETERS,
    PX4_PARAMETERS,
    failsafes,
    px4_failsafes,
)
from mavlink_bridge.preflight.rules import (
    DoctorFinding,
    ParameterRule,
    Read,
    ardupilot_rules,
    arming_rules,
    find_source_set,
    gnss_rules,
    missing_feature,
    px4_rules,
)
from mavlink_bridge.vehicle.profile import select_profile

_CONNECT_S = 15.0
_MEASURE_S = 4.0
_ROUND_TRIP_LIMIT_MS = 30.0
_RATE_SHARE = 0.7
_LOST_SHARE = 0.02
_GIMBAL_AGE_NS = 200_000_000  # of an exposure, roughly
_PX4_RATE_HZ = 30.0  # its documentation asks for 30 to 50 Hz


@dataclass(frozen=True)
class Diagnosis:
    """Results of all checks; the vehicle is fit to fly if no required one fails. state: the
    vehicle's state meanwhile, None if it was not contacted.
    """

    findings: tuple[DoctorFinding, ...]
    state: VehicleState | None = None

    @property
    def ok(self) -> bool:
        """Whether every required check passed."""
        return all(f.ok for f in self.findings if f.required)

    @property
    def exit_code(self) -> int:
        """0: all passed, 1: advice, 2: not fit to fly."""
        if not self.ok:
            return 2
        return 0 if all(f.ok for f in self.findings) else 1

    @property
    def fixable(self) -> tuple[DoctorFinding, ...]:
        """The failed checks that writing a parameter corrects."""
        return tuple(f for f in self.findings if not f.ok and f.fix is not None)


def check_parameters(rules: Iterable[ParameterRule], read: Read) -> list[DoctorFinding]:
    """Compare parameters with each rule. read: gives a value, None if it does not exist."""
    findings = []
    for rule in rules:
        name, value = rule.names[0], None
        for name in rule.names:
            value = read(name)
            if value is not None:
                break
        if value is None:
            finding = DoctorFinding(
                rule.names[0], "missing", rule.needed, rule.why, False, rule.required
            )
        else:
            ok = rule.holds(value)
            fix = None if ok else rule.fix(value)
            finding = DoctorFinding(
                name, f"{value:.7g}", rule.needed, rule.why, ok, rule.required, fix, rule.reboot
            )
        findings.append(finding)
    return findings


@dataclass(frozen=True)
class _Measurement:
    """Counters before and after `seconds` on the link, and the vehicle at their end."""

    state: VehicleState
    before: Figures
    after: Figures
    seconds: float
    gimbal: GimbalAttitude | None

    def increase(self, key: str) -> float:
        """Increase of a counter."""
        return float(self.after.get(key) or 0) - float(self.before.get(key) or 0)


def check_link(config: BridgeConfig) -> tuple[list[DoctorFinding], VehicleState]:
    """Connect in shadow mode for some 7 s (15 s without a vehicle); check identity, clock and
    streams. The findings, of which the first is the connection's, and the vehicle's state. No other
    program may use the connection.
    """
    quiet = config.model_copy(update={"mode": "shadow", "tlog": None})
    with Bridge(quiet, 0.0) as bridge:
        if not sleep_until(lambda: bridge.state().connected, _CONNECT_S, step_s=0.05):
            return [_no_connection(config, bridge.counters())], bridge.state()
        time.sleep(_MEASURE_S / 2)
        measured = _measure(bridge, config.camera.mount == "gimbal")
    findings = [*_vehicle_findings(config, measured), *_stream_findings(config, measured)]
    return findings, measured.state


def _no_connection(config: BridgeConfig, counters: Figures) -> DoctorFinding:
    found, why = "silence", "wiring, port, SERIALn_PROTOCOL=2, signing key"
    if counters["fc_open_failures"] and not counters["fc_opened"]:
        found = "cannot be opened"
        why = "nothing there, no permission, or in use: is the companion running?"
    return DoctorFinding(
        "connection", found, f"heartbeats at {config.connection}", why, False, True
    )


def _measure(bridge: Bridge, gimbal: bool) -> _Measurement:
    before, begun_s = bridge.counters(), time.monotonic()
    time.sleep(_MEASURE_S)
    after, seconds = bridge.counters(), time.monotonic() - begun_s

    def angles() -> GimbalAttitude | None:
        return bridge.gimbal_at(monotonic_ns() - _GIMBAL_AGE_NS)

    if gimbal:  # one moment says little: a hiccup of this computer is no silence
        sleep_until(lambda: angles() is not None, _MEASURE_S)
    return _Measurement(bridge.state(), before, after, seconds, angles())


def _vehicle_findings(config: BridgeConfig, measured: _Measurement) -> list[DoctorFinding]:
    """Findings about the vehicle's identity, and whether it accepts the configured message."""
    state, message = measured.state, config.injection.message
    profile = select_profile(state.autopilot, state.version)
    version = "unknown" if state.version is None else ".".join(map(str, state.version))
    several = bool(measured.after.get("bridge_other_autopilots"))
    findings = [
        DoctorFinding("connection", f"system {state.system_id}", "heartbeats", "", True, True),
        DoctorFinding(
            "vehicles",
            "several" if several else "one",
            "one, or bridge.system_id",
            "positions and parameters must not go to another vehicle",
            not several,
            True,
        ),
        DoctorFinding(
            "firmware",
            f"{state.autopilot} {version}",
            "a known profile",
            f"profile: {profile.name}",
            profile.known,
            False,
        ),
        DoctorFinding(
            "injection",
            message,
            " or ".join(profile.messages),
            "other messages are dropped without a word",
            message in profile.messages,
            True,
        ),
        DoctorFinding(
            "EKF origin",
            "read" if state.origin else ("configured" if config.origin else "none"),
            "read or configured",
            "without one: 'AHRS: waiting for home'; wait for a GNSS fix, or set bridge.origin",
            state.origin is not None or config.origin is not None or message == "gps_input",
            True,
        ),
    ]
    if state.autopilot == "px4" and message in ("vision_position_estimate", "odometry"):
        rate = config.injection.rate_hz
        why = "external vision is not fused at lower rates; set bridge.injection.rate_hz"
        enough = rate >= _PX4_RATE_HZ
        findings.append(DoctorFinding("rate_hz", f"{rate:g}", ">= 30 for PX4", why, enough, False))
    return findings


def _stream_findings(config: BridgeConfig, measured: _Measurement) -> list[DoctorFinding]:
    """Findings about the streams: rate, delay and losses."""
    source = measured.state.clock_source
    round_trip = float(measured.after["clock_round_trip_ms"] or 0)
    attitude = measured.increase("rx_ATTITUDE") / measured.seconds
    wanted = config.attitude_rate_hz * _RATE_SHARE
    received = measured.increase("fc_messages") + measured.increase("fc_skipped_messages")
    lost = measured.increase("fc_lost") / max(received, 1.0)
    findings = [
        DoctorFinding(
            "clock",
            f"{source}, {round_trip:.1f} ms",
            f"timesync within {_ROUND_TRIP_LIMIT_MS:.0f} ms",
            "attitude and gimbal are looked up at exposure time",
            source == "timesync" and round_trip <= _ROUND_TRIP_LIMIT_MS,
            True,
        ),
        DoctorFinding(
            "ATTITUDE",
            f"{attitude:.0f} Hz",
            f">= {wanted:.0f} Hz",
            "raise the port's baud rate or lower attitude_rate_hz",
            attitude >= wanted,
            True,
        ),
        DoctorFinding(
            "lost messages",
            f"{100 * lost:.1f} %",
            f"<= {100 * _LOST_SHARE:.0f} %",
            "flow control, baud rate, cable",
            lost <= _LOST_SHARE,
            False,
        ),
    ]
    if config.camera.mount == "gimbal":
        findings.append(
            DoctorFinding(
                "gimbal",
                "silent" if measured.gimbal is None else measured.gimbal.source,
                "GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_STATUS",
                "set MNT1_TYPE to the gimbal's type; or bridge.camera.mount: fixed",
                measured.gimbal is not None,
                True,
            )
        )
    return findings


def check_computer_clock(config: BridgeConfig) -> list[DoctorFinding]:
    """A finding on whether this computer's clock (UTC) is set; [] if neither GPS_INPUT nor signing
    is configured, which need it.
    """
    if config.injection.message != "gps_input" and not (config.signing or config.ground_signing):
        return []
    utc = SteadyUtc()
    year = time.gmtime(utc.utc_ns(monotonic_ns()) * 1e-9).tm_year
    why = "GPS_INPUT and signatures carry the time; set it by NTP or a battery clock"
    return [DoctorFinding("computer clock", str(year), "the present", why, utc.is_set, True)]


def examine(config: BridgeConfig, say: Callable[[str], None] = lambda _: None) -> Diagnosis:
    """Run all checks on the vehicle, for 7 s or more, and write none of its parameters. Without a
    vehicle, or with several, no parameters are checked. say: receives each step as text.
    """
    findings, state = check_link(config)
    findings += check_computer_clock(config)
    if not findings[0].ok or any(f.name == "vehicles" and not f.ok for f in findings):
        return Diagnosis(tuple(findings), state)
    say("reading the vehicle's parameters")
    px4 = state.autopilot == "px4"
    with ParameterClient(config) as client:
        missing = missing_feature(config, client.read, px4=px4)
        if missing is not None:
            name, option = missing
            why = f"another firmware, built with {option}"
            found = DoctorFinding("firmware feature", f"no {name}", config.injection.message, why,
                                  False, True)  # fmt: skip
            return Diagnosis((*findings, found), state)
        if px4:
            rules: Sequence[ParameterRule] = px4_rules(config, client.read)
            findings += _source_switch_of_px4(config)
        else:
            source_set = find_source_set(config, client.read)
            rules = [
                *ardupilot_rules(config, source_set),
                *arming_rules(config, source_set, client.read),
                *(gnss_rules(client.read) if source_set > 1 else ()),
            ]
        findings += check_parameters(rules, client.read)
        known = client.read_known(PX4_PARAMETERS if px4 else PARAMETERS)
        findings += (px4_failsafes if px4 else failsafes)(config, known.get)
    return Diagnosis(tuple(findings), state)


def _source_switch_of_px4(config: BridgeConfig) -> list[DoctorFinding]:
    """Finding for a source switch with PX4, which would answer UNSUPPORTED in flight."""
    if not config.switch.enabled:
        return []
    why = "PX4 has no source sets (SET_EKF_SOURCE_SET): it fuses GNSS and vision together"
    return [
        DoctorFinding("source switch", "enabled", "bridge.switch.enabled false", why, False, True)
    ]


def repair(config: BridgeConfig, findings: Iterable[DoctorFinding]) -> bool:
    """Write the value of each `DoctorFinding.fix` to the vehicle, in order; True if a reboot is
    needed, which is not ordered. `ParameterError` ends it at the first value that is not accepted.

    The order matters: the other VISO parameters exist only after VISO_TYPE is set.
    """
    reboot = False
    with ParameterClient(config) as client:
        for finding in findings:
            if finding.fix is not None:
                client.write(finding.name, finding.fix)
                reboot = reboot or finding.reboot
    return reboot
