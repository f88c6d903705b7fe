"""Required flight-controller parameters for the configured injection.

Each ArduPilot rule comes from a refusal or error that was measured (messages.md); PX4's are from
its documentation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from mavlink_bridge.config import BridgeConfig
from mavlink_bridge.injection.encode import GLOBAL_SENSOR_ID, VELOCITY_SIGMA_MPS

_SOURCE_SETS = (1, 2, 3)
_PX4_LATE_MS = 50.0
_AGP_INSTANCES = 4
_AGP_CONTROLS = ("EKF2_AGP0_CTRL", "EKF2_AGP_CTRL")
_OWN_SOURCES = 0b1001  # FuseAllVelocities, UsePerCoreEKFSources
_ALL_CHECKS = 1  # bit 0 of ARMING_CHECK, whatever the other bits say
_EVERY_CHECK = (1 << 21) - 2  # bits 1 to 20, the last is OSD
_VISION_CHECK = 1 << 18

Read = Callable[[str], float | None]


@dataclass(frozen=True)
class DoctorFinding:
    """Result of one check. required: if it fails, the vehicle is not fit to fly; otherwise advice;
    fix: parameter value to write, None if none would help; reboot: needed after it.
    """

    name: str
    found: str
    needed: str
    why: str
    ok: bool
    required: bool
    fix: float | None = None
    reboot: bool = False


@dataclass(frozen=True)
class ParameterRule:
    """A parameter's requirement. names: the parameter and its older names, newest first.

    allowed: correct values, the first of which is written; empty if `minimum` bounds the value or
    `bits` must be set. required: whether a flight fails without it; otherwise it is advice.
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
        """The allowed values, the bound or the bits as text."""
        if self.bits:
            return f"bits {self.bits:#x} set"
        if math.isfinite(self.minimum):
            return f">= {self.minimum:g}"
        return " or ".join(f"{value:.7g}" for value in self.allowed)

    def holds(self, value: float) -> bool:
        """Whether a value satisfies the rule; NaN and infinity do not."""
        if not math.isfinite(value):
            return False
        if self.bits:
            return int(value) & self.bits == self.bits
        if math.isfinite(self.minimum):
            return value >= self.minimum
        return any(abs(value - allowed) <= self.tolerance for allowed in self.allowed)

    def fix(self, value: float) -> float:
        """The value to write instead of a wrong one."""
        if self.bits:
            return float((int(value) if math.isfinite(value) else 0) | self.bits)
        return self.minimum if math.isfinite(self.minimum) else self.allowed[0]


def find_source_set(config: BridgeConfig, read: Read) -> int:
    """Number (1 to 3) of the EK3 source set that uses the injected positions, or should."""
    if config.switch.enabled:
        return config.switch.vision_set
    if config.injection.message == "external_position_estimate":
        return config.switch.gnss_set
    wanted = 3.0 if config.injection.message == "gps_input" else 6.0
    for number in _SOURCE_SETS:
        if read(f"EK3_SRC{number}_POSXY") == wanted:
            return number
    # A vehicle that flies on GNSS keeps doing so: vision goes into the set it is switched to.
    receiver = read("GPS1_TYPE") or read("GPS_TYPE") or 0.0
    return config.switch.vision_set if receiver else 1


def ardupilot_rules(config: BridgeConfig, source_set: int) -> list[ParameterRule]:
    """The values that ArduPilot's parameters must have for the configured injection. source_set:
    number of the EKF's source set that uses vision.
    """
    common = [
        ParameterRule(("AHRS_EKF_TYPE",), (3.0,), "only EKF3 has external navigation sources"),
        ParameterRule(
            ("EK3_ENABLE",), (1.0,), "only EKF3 has external navigation sources", reboot=True
        ),
    ]
    if config.injection.message == "external_position_estimate":
        return common  # it has no source set
    if config.injection.message == "gps_input":
        return common + _gps_input_rules(config, source_set)
    return common + _vision_rules(config, source_set)


def arming_rules(config: BridgeConfig, source_set: int, read: Read) -> list[ParameterRule]:
    """Rules for arming on GNSS while VISO_TYPE is set and no vision arrives yet.

    ArduPilot then refuses to arm ('VisOdom: not healthy'). In shadow mode this is always so. A
    vehicle that takes off on vision (source set 1) keeps the check. ARMING_CHECK names the checks
    to do, ARMING_SKIPCHK (4.7 and later) those to leave out.
    """
    gps_input = config.injection.message == "gps_input"
    if config.injection.gps_id == 0 if gps_input else source_set == 1:
        return []
    required = not gps_input and config.mode != "inject"
    why = "no vision on the ground: 'VisOdom: not healthy' refuses to arm (bit 18)"
    checks = read("ARMING_CHECK")
    if checks is None:
        return [ParameterRule(("ARMING_SKIPCHK",), (), why, required, bits=_VISION_CHECK)]
    listed = int(checks) if math.isfinite(checks) else _ALL_CHECKS
    done = _EVERY_CHECK if listed & _ALL_CHECKS else listed
    return [ParameterRule(("ARMING_CHECK",), (float(done & ~_VISION_CHECK),), why, required)]


def _vision_rules(config: BridgeConfig, number: int) -> list[ParameterRule]:
    prefix = f"EK3_SRC{number}_"
    injection = config.injection
    odometry = injection.message == "odometry"
    climb = (6.0, 0.0) if odometry else (0.0,)
    why = "the message can carry velocity" if odometry else "the message carries no velocity"
    delta = "3 refuses to arm ('require GPS'); with 0 the vehicle lands 8 s after the position"
    delta += " is withheld, with 6 odometry holds it (VISION_POSITION_DELTA)"
    rules = [
        ParameterRule(("VISO_TYPE",), (1.0,), "MAVLink vision is ignored otherwise", reboot=True),
        ParameterRule((prefix + "POSXY",), (6.0,), "horizontal position from external navigation"),
        ParameterRule((prefix + "VELXY",), (6.0, 0.0), delta),
        ParameterRule((prefix + "VELXY",), (6.0,), delta, required=False),
        ParameterRule((prefix + "VELZ",), climb, why + " (3: refuses to arm, 'require GPS')"),
        ParameterRule(
            (prefix + "POSZ",),
            (1.0,),
            "vision is rougher, 3 follows wrong GNSS",
            required=False,
        ),
        ParameterRule(
            (prefix + "YAW",), (1.0,), "a wrong vision yaw is taken unseen", required=False
        ),
        ParameterRule(
            ("VISO_DELAY_MS",),
            (round(injection.delay_ms),),
            "the age at which the bridge sends; 300 ms unsaid cost 2.4 m",
            tolerance=10.0,
            reboot=True,  # the EKF sizes its buffers by it at boot
        ),
        ParameterRule(("VISO_SCALE",), (1.0,), "positions are metres", tolerance=1e-3),
    ]
    rules += [
        ParameterRule(
            (f"VISO_POS_{axis}",), (0.0,), "the bridge sends the autopilot's place", False
        )
        for axis in "XYZ"
    ]
    rules += [
        ParameterRule(
            (f"EK3_VIS_VERR_{end}",), (sigma,), "m/s that a confidence means", False, tolerance=1e-3
        )
        for end, sigma in zip(("MIN", "MAX"), VELOCITY_SIGMA_MPS, strict=True)
    ]
    if not odometry:
        rules.append(
            ParameterRule(
                ("VISO_QUAL_MIN",), (0.0,), "the message has no quality; > 0 rejects all of it"
            )
        )
    if number == 1:
        rules.append(
            ParameterRule(
                ("GPS1_TYPE", "GPS_TYPE"),
                (0.0,),
                "an absent receiver blocks arming ('Bad fix')",
                required=False,
                reboot=True,
            )
        )
    return rules


def _gps_input_rules(config: BridgeConfig, number: int) -> list[ParameterRule]:
    injection = config.injection
    gps = injection.gps_id + 1
    prefix = f"EK3_SRC{number}_"
    velocity = (3.0, 0.0) if injection.gps_velocity else (0.0,)
    yaw = (2.0,) if injection.gps_yaw else (1.0,)
    old_type = "GPS_TYPE" if gps == 1 else f"GPS_TYPE{gps}"
    old_delay = "GPS_DELAY_MS" if gps == 1 else f"GPS_DELAY_MS{gps}"
    why = "velocity is sent" if injection.gps_velocity else "no velocity is sent"
    return [
        ParameterRule((f"GPS{gps}_TYPE", old_type), (14.0,), "the MAVLink receiver", reboot=True),
        ParameterRule((prefix + "POSXY",), (3.0,), "horizontal position from GPS"),
        ParameterRule((prefix + "VELXY",), velocity, why),
        ParameterRule((prefix + "VELZ",), velocity, why),
        ParameterRule((prefix + "POSZ",), (1.0,), "the barometer is smoother", required=False),
        ParameterRule((prefix + "YAW",), yaw, "2 with gps_yaw, else the compass"),
        ParameterRule(
            (f"GPS{gps}_DELAY_MS", old_delay),
            (round(injection.delay_ms),),
            "the age at which the bridge sends",
            tolerance=10.0,
            reboot=True,
        ),
        *(_horizon_rules(injection.delay_ms) if gps > 1 else ()),
    ]


def _horizon_rules(delay_ms: float) -> list[ParameterRule]:
    """Rules for EKF3's buffer. It is sized at the start by the delay of the first receiver and of
    vision. Older positions of another receiver are fused late, by the difference: 1 m behind at 8
    m/s and 220 ms. Vision's delay makes room, although no vision message is sent.
    """
    why = "room in the EKF's buffer for a second receiver; or let GPS_INPUT be the first, gps_id 0"
    return [
        ParameterRule(("VISO_TYPE",), (1.0,), why, required=False, reboot=True),
        ParameterRule(
            ("VISO_DELAY_MS",),
            (),
            why,
            required=False,
            minimum=round(delay_ms),
            reboot=True,
        ),
    ]


def missing_feature(config: BridgeConfig, read: Read, *, px4: bool) -> tuple[str, str] | None:
    """A parameter whose absence shows that the firmware was built without a required feature, and
    the build option that adds it; None if nothing is missing.

    Firmware for boards with 1 MB of flash lacks it. MAVLink has no capability flag for it.
    """
    message = config.injection.message
    parameters: tuple[str, ...]
    if px4 and message == "global_position_sensor":
        parameters, option = _AGP_CONTROLS, "CONFIG_EKF2_AUX_GLOBAL_POSITION=y (PX4 1.15 or later)"
    elif px4:
        parameters, option = ("EKF2_EV_CTRL",), "CONFIG_EKF2_EXTERNAL_VISION=y (PX4 1.14 or later)"
    elif message in ("gps_input", "external_position_estimate"):
        return None
    elif read("EK3_SRC1_POSXY") is None:
        parameters, option = ("EK3_SRC1_POSXY",), "HAL_NAVEKF3_AVAILABLE (ArduPilot 4.1 or later)"
    else:
        parameters = ("VISO_TYPE",)
        option = "HAL_VISUALODOM_ENABLED and EK3_FEATURE_EXTERNAL_NAV (custom.ardupilot.org: "
        option += "Visual Odometry, External navigation for EKF3)"
    return None if any(read(p) is not None for p in parameters) else (parameters[0], option)


def gnss_rules(read: Read) -> list[ParameterRule]:
    """Rules for ArduPilot with GNSS and vision: GNSS must not be fused while vision is selected."""
    if not (read("GPS1_TYPE") or read("GPS_TYPE")):
        return []
    rules = []
    options = read("EK3_SRC_OPTIONS")
    if options is not None:
        why = "bit 0 fuses GNSS velocity in the vision set; bit 3 gives each EKF core a source "
        why += "set, and a core that fails brings GNSS back"
        kept = int(options) & ~_OWN_SOURCES if math.isfinite(options) else 0
        rules.append(ParameterRule(("EK3_SRC_OPTIONS",), (float(kept),), why))
    if read("SCR_ENABLE"):
        why = "a script may select the source set (ahrs-source*.lua): remove it"
        rules.append(ParameterRule(("SCR_ENABLE",), (0.0,), why, required=False, reboot=True))
    return rules


def px4_rules(config: BridgeConfig, read: Read) -> list[ParameterRule]:
    """Rules for PX4, from its documentation; not flown here."""
    injection = config.injection
    horizon = ParameterRule(
        ("EKF2_DELAY_MAX",),
        (),
        "older measurements are not fused; 50 ms for late ones",
        required=False,
        minimum=injection.delay_ms + _PX4_LATE_MS,
        reboot=True,
    )
    if injection.message == "global_position_sensor":
        return [*_agp_rules(read), horizon]
    odometry = injection.message == "odometry"
    stamped = "stamps are exposure times, mapped by TIMESYNC: a delay would count twice"
    rules = [
        ParameterRule(("EKF2_EV_CTRL",), (), "bit 0: horizontal position", bits=0b0001),
        ParameterRule(("EKF2_EV_DELAY",), (0.0,), stamped, tolerance=10.0, reboot=True),
        ParameterRule(
            ("EKF2_EV_NOISE_MD",), (0.0,), "1 ignores the covariance that is sent", False
        ),
        horizon,
    ]
    if not odometry:
        rules.append(ParameterRule(("EKF2_EV_QMIN",), (0.0,), "the message has no quality"))
    return rules + [
        ParameterRule(
            (f"EKF2_EV_POS_{axis}",), (0.0,), "the bridge sends the autopilot's place", False
        )
        for axis in "XYZ"
    ]


def _agp_rules(read: Read) -> list[ParameterRule]:
    """Rules for the instance with our sensor's id, or the first; one instance has no ids."""
    why = "bit 0: horizontal position"
    if read("EKF2_AGP0_ID") is None:
        return [ParameterRule(_AGP_CONTROLS, (), why, bits=1)]
    ours = (n for n in range(_AGP_INSTANCES) if read(f"EKF2_AGP{n}_ID") == GLOBAL_SENSOR_ID)
    prefix = f"EKF2_AGP{next(ours, 0)}_"
    return [
        ParameterRule(
            (prefix + "ID",),
            (float(GLOBAL_SENSOR_ID),),
            "the id that the bridge sends",
            reboot=True,
        ),
        ParameterRule((prefix + "CTRL",), (), why, bits=1),
    ]
