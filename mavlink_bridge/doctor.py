"""What must be right before a flight: parameters for the chosen injection, link, clock, streams.

Every rule below is a refusal or an error that was measured on ArduCopter (docs/bridge.md).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from mavlink_bridge.bridge import Bridge
from mavlink_bridge.clock import SteadyUtc, monotonic_ns
from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.parameters import ParameterClient
from mavlink_bridge.profile import select_profile

_CONNECT_S = 15.0
_MEASURE_S = 4.0
_ROUND_TRIP_LIMIT_MS = 30.0
_RATE_SHARE = 0.7
_SOURCE_SETS = (1, 2, 3)
_LOST_SHARE = 0.02

Read = Callable[[str], float | None]


@dataclass(frozen=True)
class Rule:
    """A parameter's requirement. names: the parameter and its older names, newest first.

    allowed: values that are right, the first being the one to write; None with `minimum` or
    `maximum` for a bound. required: a flight fails without it; otherwise it is advice.
    """

    names: tuple[str, ...]
    allowed: tuple[float, ...]
    why: str
    required: bool = True
    reboot: bool = False
    tolerance: float = 0.0
    minimum: float = -math.inf
    bits: int = 0

    @property
    def needed(self) -> str:
        """For the table."""
        if self.bits:
            return f"bits {self.bits:#x} set"
        if math.isfinite(self.minimum):
            return f">= {self.minimum:g}"
        return " or ".join(f"{value:g}" for value in self.allowed)

    def holds(self, value: float) -> bool:
        """Whether a value satisfies it."""
        if self.bits:
            return int(value) & self.bits == self.bits
        if math.isfinite(self.minimum):
            return value >= self.minimum
        return any(abs(value - allowed) <= self.tolerance for allowed in self.allowed)

    def fix(self, value: float) -> float:
        """What to write over a value that does not hold."""
        if self.bits:
            return float(int(value) | self.bits)
        return self.minimum if math.isfinite(self.minimum) else self.allowed[0]


@dataclass(frozen=True)
class Finding:
    """One line of the table. fix: the value to write, None where writing cannot help."""

    name: str
    found: str
    needed: str
    why: str
    ok: bool
    required: bool
    fix: float | None = None
    reboot: bool = False


@dataclass(frozen=True)
class Diagnosis:
    """All lines; a flight may begin when none that is required fails."""

    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether every required line holds."""
        return all(f.ok for f in self.findings if f.required)

    @property
    def exit_code(self) -> int:
        """For scripts: 0 good, 1 advice, 2 not fit to fly."""
        if not self.ok:
            return 2
        return 0 if all(f.ok for f in self.findings) else 1

    @property
    def fixable(self) -> tuple[Finding, ...]:
        """The lines that writing a parameter puts right."""
        return tuple(f for f in self.findings if not f.ok and f.fix is not None)


# --- the rules --------------------------------------------------------------------------------


def find_source_set(config: BridgeConfig, read: Read) -> int:
    """The EK3 source set that takes the injection: the one that does already, or should."""
    if config.switch.enabled:
        return config.switch.vision_set
    wanted = 3.0 if config.injection.message == "gps_input" else 6.0
    for number in _SOURCE_SETS:
        if read(f"EK3_SRC{number}_POSXY") == wanted:
            return number
    # A vehicle that flies on GNSS keeps doing so: vision goes into the set it is switched to.
    receiver = read("GPS1_TYPE") or read("GPS_TYPE") or 0.0
    return config.switch.vision_set if receiver else 1


def ardupilot_rules(config: BridgeConfig, source_set: int) -> list[Rule]:
    """What ArduPilot needs for the configured injection in a source set."""
    common = [
        Rule(("AHRS_EKF_TYPE",), (3.0,), "only EKF3 has external navigation sources"),
        Rule(("EK3_ENABLE",), (1.0,), "only EKF3 has external navigation sources", reboot=True),
    ]
    if config.injection.message == "gps_input":
        return common + _gps_input_rules(config, source_set)
    return common + _vision_rules(config, source_set)


def _vision_rules(config: BridgeConfig, number: int) -> list[Rule]:
    prefix = f"EK3_SRC{number}_"
    injection = config.injection
    odometry = injection.message == "odometry"
    velocity = (6.0, 0.0) if odometry else (0.0,)
    why = "the message carries velocity" if odometry else "the message carries no velocity"
    rules = [
        Rule(("VISO_TYPE",), (1.0,), "MAVLink vision is ignored otherwise", reboot=True),
        Rule((prefix + "POSXY",), (6.0,), "horizontal position from external navigation"),
        Rule((prefix + "VELXY",), velocity, why + " (3: refuses to arm, 'require GPS')"),
        Rule((prefix + "VELZ",), velocity, why + " (3: refuses to arm, 'require GPS')"),
        Rule((prefix + "POSZ",), (1.0,), "the barometer is smoother than vision", required=False),
        Rule((prefix + "YAW",), (1.0,), "a wrong vision yaw is taken unseen", required=False),
        Rule(
            ("VISO_DELAY_MS",),
            (round(injection.delay_ms),),
            "the age at which the bridge sends; 300 ms unsaid cost 2.4 m",
            tolerance=10.0,
            reboot=True,  # the EKF sizes its buffers by it at boot
        ),
        Rule(("VISO_SCALE",), (1.0,), "positions are metres", tolerance=1e-3),
    ]
    rules += [
        Rule((f"VISO_POS_{axis}",), (0.0,), "the bridge sends the autopilot's place", False)
        for axis in "XYZ"
    ]
    if odometry:
        rules.append(
            Rule(
                ("VISO_VEL_M_NSE",),
                (),
                "velocity derived from positions is no better",
                required=False,
                minimum=0.3,
            )
        )
    else:
        rules.append(
            Rule(("VISO_QUAL_MIN",), (0.0,), "the message has no quality; > 0 rejects all of it")
        )
    if number == 1:
        rules.append(
            Rule(
                ("GPS1_TYPE", "GPS_TYPE"),
                (0.0,),
                "an absent receiver blocks arming ('Bad fix')",
                required=False,
                reboot=True,
            )
        )
    return rules


def _gps_input_rules(config: BridgeConfig, number: int) -> list[Rule]:
    injection = config.injection
    gps = injection.gps_id + 1
    prefix = f"EK3_SRC{number}_"
    velocity = (3.0, 0.0) if injection.gps_velocity else (0.0,)
    yaw = (2.0,) if injection.gps_yaw else (1.0,)
    old_type = "GPS_TYPE" if gps == 1 else f"GPS_TYPE{gps}"
    old_delay = "GPS_DELAY_MS" if gps == 1 else f"GPS_DELAY_MS{gps}"
    why = "velocity is sent" if injection.gps_velocity else "no velocity is sent"
    return [
        Rule((f"GPS{gps}_TYPE", old_type), (14.0,), "the MAVLink receiver", reboot=True),
        Rule((prefix + "POSXY",), (3.0,), "horizontal position from GPS"),
        Rule((prefix + "VELXY",), velocity, why),
        Rule((prefix + "VELZ",), velocity, why),
        Rule((prefix + "POSZ",), (1.0,), "the barometer is smoother", required=False),
        Rule((prefix + "YAW",), yaw, "2 with gps_yaw, else the compass"),
        Rule(
            (f"GPS{gps}_DELAY_MS", old_delay),
            (round(injection.delay_ms),),
            "the age at which the bridge sends",
            tolerance=10.0,
            reboot=True,
        ),
    ]


def px4_rules(config: BridgeConfig) -> list[Rule]:
    """What PX4 needs; from its documentation, not flown here."""
    injection = config.injection
    if injection.message == "global_position_sensor":
        return [Rule(("EKF2_AGP_CTRL",), (), "bit 0: horizontal position", bits=1)]
    bits = 0b0101 if injection.message == "odometry" else 0b0001
    return [
        Rule(("EKF2_EV_CTRL",), (), "bit 0: horizontal position, bit 2: velocity", bits=bits),
        Rule(
            ("EKF2_EV_DELAY",),
            (injection.delay_ms,),
            "the age at which the bridge sends",
            tolerance=10.0,
            reboot=True,
        ),
    ]


# --- examinations -----------------------------------------------------------------------------


def check_parameters(rules: Iterable[Rule], read: Read) -> list[Finding]:
    """Compare each rule with what the flight controller says."""
    findings = []
    for rule in rules:
        name, value = rule.names[0], None
        for name in rule.names:
            value = read(name)
            if value is not None:
                break
        if value is None:
            finding = Finding(rule.names[0], "missing", rule.needed, rule.why, False, rule.required)
        else:
            ok = rule.holds(value)
            fix = None if ok else rule.fix(value)
            finding = Finding(
                name, f"{value:g}", rule.needed, rule.why, ok, rule.required, fix, rule.reboot
            )
        findings.append(finding)
    return findings


def check_link(config: BridgeConfig) -> tuple[list[Finding], VehicleState]:
    """Connect in shadow mode for a few seconds and measure identity, clock and streams."""
    quiet = config.model_copy(update={"mode": "shadow", "tlog": None})
    with Bridge(quiet, 0.0) as bridge:
        end = time.monotonic() + _CONNECT_S
        while not bridge.state().connected and time.monotonic() < end:
            time.sleep(0.05)
        if not bridge.state().connected:
            needed = f"heartbeats at {config.connection}"
            why = "wiring, port, SERIALn_PROTOCOL=2, signing key"
            return [Finding("connection", "silence", needed, why, False, True)], bridge.state()
        time.sleep(_MEASURE_S / 2)
        before = bridge.counters()
        time.sleep(_MEASURE_S)
        return _link_findings(config, bridge, before), bridge.state()


def _link_findings(
    config: BridgeConfig, bridge: Bridge, before: dict[str, int | float | str]
) -> list[Finding]:
    state, after = bridge.state(), bridge.counters()

    def grown(key: str) -> float:
        return float(after.get(key, 0)) - float(before.get(key, 0))

    profile = select_profile(state.autopilot, state.version)
    version = "unknown" if state.version is None else ".".join(map(str, state.version))
    round_trip = float(after["clock_round_trip_ms"])
    attitude = grown("rx_ATTITUDE") / _MEASURE_S
    wanted = config.attitude_rate_hz * _RATE_SHARE
    received = max(grown("fc_messages") + grown("fc_skipped_messages"), 1.0)
    lost = grown("fc_lost") / received
    message = config.injection.message
    findings = [
        Finding("connection", f"system {state.system_id}", "heartbeats", "", True, True),
        Finding(
            "firmware",
            f"{state.autopilot} {version}",
            "a known profile",
            f"profile: {profile.name}",
            profile.known,
            False,
        ),
        Finding(
            "injection",
            message,
            " or ".join(profile.messages),
            "other messages are dropped without a word",
            message in profile.messages,
            True,
        ),
        Finding(
            "clock",
            f"{state.clock_source}, {round_trip:.1f} ms",
            f"timesync within {_ROUND_TRIP_LIMIT_MS:.0f} ms",
            "attitude and gimbal are looked up at exposure time",
            state.clock_source == "timesync" and round_trip <= _ROUND_TRIP_LIMIT_MS,
            True,
        ),
        Finding(
            "ATTITUDE",
            f"{attitude:.0f} Hz",
            f">= {wanted:.0f} Hz",
            "raise the port's baud rate or lower attitude_rate_hz",
            attitude >= wanted,
            True,
        ),
        Finding(
            "lost messages",
            f"{100 * lost:.1f} %",
            f"<= {100 * _LOST_SHARE:.0f} %",
            "flow control, baud rate, cable",
            lost <= _LOST_SHARE,
            False,
        ),
        Finding(
            "EKF origin",
            "read" if state.origin else ("configured" if config.origin else "none"),
            "read or configured",
            "without one: 'AHRS: waiting for home'; set bridge.origin",
            state.origin is not None or config.origin is not None or message == "gps_input",
            True,
        ),
    ]
    if config.camera.mount == "gimbal":
        at = bridge.gimbal_at(time.monotonic_ns() - 200_000_000)
        findings.append(
            Finding(
                "gimbal",
                "silent" if at is None else at.source,
                "GIMBAL_DEVICE_ATTITUDE_STATUS or MOUNT_STATUS",
                "MNT1_TYPE; or bridge.camera.mount: fixed",
                at is not None,
                True,
            )
        )
    return findings


def check_computer_clock(config: BridgeConfig) -> list[Finding]:
    """A computer without a battery clock wakes up in the past; some links care."""
    if config.injection.message != "gps_input" and not (config.signing or config.ground_signing):
        return []
    utc = SteadyUtc()
    year = time.gmtime(utc.utc_ns(monotonic_ns()) * 1e-9).tm_year
    why = "GPS_INPUT and signatures carry the time; set it by NTP or a battery clock"
    return [Finding("computer clock", str(year), "the present", why, utc.is_set, True)]


def examine(config: BridgeConfig) -> Diagnosis:
    """Connect, measure the link, read the parameters and judge."""
    findings, state = check_link(config)
    findings += check_computer_clock(config)
    if not findings[0].ok:
        return Diagnosis(tuple(findings))
    with ParameterClient(config) as client:
        if state.autopilot == "px4":
            rules: Sequence[Rule] = px4_rules(config)
        else:
            rules = ardupilot_rules(config, find_source_set(config, client.read))
        findings += check_parameters(rules, client.read)
    return Diagnosis(tuple(findings))


def repair(config: BridgeConfig, findings: Iterable[Finding]) -> bool:
    """Write what `Finding.fix` says, in order; True if a reboot is needed for it to count.

    The order matters: VISO_TYPE brings the other VISO parameters into being.
    """
    reboot = False
    with ParameterClient(config) as client:
        for finding in findings:
            if finding.fix is not None:
                client.write(finding.name, finding.fix)
                reboot = reboot or finding.reboot
    return reboot
