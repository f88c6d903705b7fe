"""Encodes an estimate as the configured one of five messages, or says why it cannot be sent."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from mavlink_bridge import quaternion as quat
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionConfig, InjectionMessage
from mavlink_bridge.injection.propagate import RISK_SIGMAS, PropagatedFix
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import Attitude, Origin, VisionFix, horizontal_sigma_m
from mavlink_bridge.vehicle.origin import ned_from_origin, north_east
from mavlink_bridge.vehicle.profile import CovarianceFormula, FirmwareProfile, covariance_entry

NAN = math.nan
# Index of the diagonal (x, y, z, roll, pitch, yaw) in MAVLink's row-major upper triangle of 6x6.
DIAGONAL = (0, 6, 11, 15, 18, 20)
_IGNORE_VELOCITY = (
    mavlink.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ
    | mavlink.GPS_INPUT_IGNORE_FLAG_VEL_VERT
    | mavlink.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY
)
_WRAPS_S = 36_000.0  # of a time in a float, as the command's definition proposes
GLOBAL_SENSOR_ID = 1  # EKF2_AGP0_ID; 0 may stand for "no sensor"
# What a receiver would claim of such an error. ArduPilot refuses to arm with hdop ignored, above
# GPS_HDOP_GOOD (1.4: a protection level of 3.5 m) or below 6 satellites.
_METRES_PER_DOP = 2.5
_LEAST_DOP, _MOST_DOP = 0.5, 99.0
_BEST_SATELLITES, _ENOUGH_SATELLITES = 12, 6
# m/s of ArduPilot's confidence 100 and 0 (EK3_VIS_VERR_MIN, EK3_VIS_VERR_MAX)
VELOCITY_SIGMA_MPS = (0.1, 2.0)
_DELTA_NOISE_MPS = 0.3  # of a velocity from two fixes of the odometry
_FARTHEST_M = 100_000.0  # from the origin: farther, one of the two is wrong


@dataclass(frozen=True)
class EncodedEstimate:
    """An estimate to send. position: propagated to the message's time; quaternion: body to NED,
    None where unknown; fresh: the fix itself, not propagated; quality: 0 to 100; velocity_is_new:
    the fix measured a velocity, which was not sent before; protection_m: horizontal and vertical
    level, None if unknown.
    """

    position: PropagatedFix
    quaternion: quat.Quaternion | None
    attitude_sigma_rad: float
    quality: int
    reset_counter: int
    fresh: bool
    velocity_is_new: bool = False
    protection_m: tuple[float, float] | None = None

    @property
    def levels_m(self) -> tuple[float, float]:
        """Horizontal and vertical protection level, m; 3.7 sigma if `protection_m` is None."""
        if self.protection_m is not None:
            return self.protection_m
        p = self.position
        return RISK_SIGMAS * p.horizontal_sigma_m, RISK_SIGMAS * p.vertical_sigma_m


def claimed_dilution(level_m: float) -> float:
    """Dilution of precision (HDOP, VDOP) that a GNSS receiver with this protection level states."""
    return min(max(level_m / _METRES_PER_DOP, _LEAST_DOP), _MOST_DOP)


def claimed_satellites(level_m: float, alert_limit_m: float) -> int:
    """Number of satellites to state: 12 for a good position, falling to 6 at the alert limit; above
    the limit 5, too few to arm.
    """
    if level_m > alert_limit_m:
        return _ENOUGH_SATELLITES - 1
    spare = _BEST_SATELLITES - _ENOUGH_SATELLITES
    return _BEST_SATELLITES - round(spare * level_m / alert_limit_m)


def pose_covariance(
    P: np.ndarray, attitude_sigma_rad: float, formula: CovarianceFormula
) -> list[float]:
    """The 21 entries of VISION_POSITION_ESTIMATE and ODOMETRY for an NED covariance P (3, 3), m².

    ArduPilot computes one position error from three entries, so each of them is the entry that it
    reads as the worst horizontal sigma (`covariance_entry`); the height's sigma is not sent. PX4
    gets variances and covariances. The angles' entries follow from `attitude_sigma_rad`.
    """
    entries = [0.0] * 21
    if formula == "variance":
        entries[0], entries[6], entries[11] = (float(P[i, i]) for i in range(3))
        entries[1], entries[2], entries[7] = float(P[0, 1]), float(P[0, 2]), float(P[1, 2])
    else:
        error = horizontal_sigma_m(P)
        for i in DIAGONAL[:3]:
            entries[i] = covariance_entry(error, formula)
    for i in DIAGONAL[3:]:
        entries[i] = covariance_entry(attitude_sigma_rad, formula)
    return entries


def vision_position_estimate(
    e: EncodedEstimate, ned: tuple[float, float, float], formula: CovarianceFormula
) -> Any:
    """VISION_POSITION_ESTIMATE (102). ned: m from the EKF origin; NaN angles if unknown."""
    covariance = pose_covariance(e.position.covariance_ned, e.attitude_sigma_rad, formula)
    angles = (NAN, NAN, NAN) if e.quaternion is None else quat.to_euler(e.quaternion)
    return mavlink.MAVLink_vision_position_estimate_message(
        e.position.time_ns // 1000, *ned, *angles, covariance, e.reset_counter
    )


def odometry(
    e: EncodedEstimate,
    q: quat.Quaternion,
    ned: tuple[float, float, float],
    formula: CovarianceFormula,
    frame: int,
) -> Any:
    """ODOMETRY (331): position NED (ned: metres from the EKF origin), velocity in the body frame.

    q: body to NED, to turn the velocity. frame: MAV_FRAME of the position. A velocity that is
    repeated or derived from the positions is sent as NaN ("unknown"), because the EKF would treat
    its error as independent.
    """
    covariance = pose_covariance(e.position.covariance_ned, e.attitude_sigma_rad, formula)
    body, velocity_covariance = (NAN, NAN, NAN), [NAN] * 21
    if e.velocity_is_new:
        vn, ve, vd = (float(v) for v in e.position.velocity_ned)
        body = quat.rotate(quat.conjugate(q), (vn, ve, vd))
        Rbn = np.array([quat.rotate(quat.conjugate(q), tuple(row)) for row in np.eye(3)]).T
        Pv = Rbn @ e.position.velocity_covariance_ned @ Rbn.T
        for k, i in enumerate(DIAGONAL[:3]):
            velocity_covariance[i] = float(Pv[k, k])
    return mavlink.MAVLink_odometry_message(
        e.position.time_ns // 1000,
        frame,
        mavlink.MAV_FRAME_BODY_FRD,
        *ned,
        list(q),
        *body,
        NAN,
        NAN,
        NAN,
        covariance,
        velocity_covariance,
        e.reset_counter,
        mavlink.MAV_ESTIMATOR_TYPE_VISION,
        e.quality,
    )


def vision_position_delta(
    before: tuple[VisionFix, Attitude], now: tuple[VisionFix, Attitude]
) -> Any | None:
    """VISION_POSITION_DELTA (11011): motion (m) and rotation between two fixes, in body axes at the
    second; None if that is not by odometry, or less certain than the message can state.

    before, now: each fix with the autopilot's attitude at its time. ArduPilot dates the message
    VISO_DELAY_MS before its arrival.
    """
    (first, then), (last, at) = before, now
    seconds = (last.time_ns - first.time_ns) * 1e-9
    place = (last.latitude_deg, last.longitude_deg)
    north, east = north_east(first.latitude_deg, first.longitude_deg, *place)
    back = quat.conjugate(at.quaternion)
    moved = quat.rotate(back, (north, east, first.height_m - last.height_m))
    w, *axis = quat.multiply(quat.conjugate(then.quaternion), at.quaternion)
    least, most = VELOCITY_SIGMA_MPS
    if last.scale_sigma is None:
        return None
    sigma = math.hypot(_DELTA_NOISE_MPS, last.scale_sigma * math.hypot(*moved) / seconds)
    if sigma > most:
        return None
    return mavlink.MAVLink_vision_position_delta_message(
        last.time_ns // 1000,
        round(seconds * 1e6),
        [math.copysign(2.0, w) * part for part in axis],
        list(moved),
        100.0 * (most - sigma) / (most - least),
    )


def gps_input(
    e: EncodedEstimate, altitude_amsl_m: float, week_ms: tuple[int, int], config: InjectionConfig
) -> Any:
    """GPS_INPUT (232), every field filled: ArduPilot does not arm if HDOP is marked as ignored.

    week_ms: GPS week and milliseconds in it. Dilution and number of satellites follow from the
    protection level, because ArduPilot judges a receiver by them.
    """
    p = e.position
    horizontal_m, vertical_m = e.levels_m
    yaw = 0  # 0 means none; north is 36000
    if config.gps_yaw and e.quaternion is not None:
        yaw = round(math.degrees(quat.to_euler(e.quaternion)[2]) % 360.0 * 100.0) or 36000
    vn, ve, vd = (float(v) for v in p.velocity_ned) if config.gps_velocity else (0.0, 0.0, 0.0)
    week, ms = week_ms
    return mavlink.MAVLink_gps_input_message(
        p.time_ns // 1000,
        config.gps_id,
        0 if config.gps_velocity else _IGNORE_VELOCITY,
        ms,
        week,
        mavlink.GPS_FIX_TYPE_3D_FIX,
        round(p.latitude_deg * 1e7),
        round(p.longitude_deg * 1e7),
        altitude_amsl_m,
        claimed_dilution(horizontal_m),
        claimed_dilution(vertical_m),
        vn,
        ve,
        vd,
        p.speed_sigma_mps,
        p.horizontal_sigma_m,
        p.vertical_sigma_m,
        claimed_satellites(horizontal_m, config.alert_limit_m),
        yaw,
    )


def global_position_sensor(e: EncodedEstimate, altitude_amsl_m: float, now_ns: int) -> Any:
    """GLOBAL_POSITION_SENSOR (296): latitude, longitude and both altitudes.

    Its timestamp is the time of transmission, and a field holds the time since the exposure. The
    other messages hold the time of the exposure.
    """
    p = e.position
    return mavlink.MAVLink_global_position_sensor_message(
        0,
        0,
        GLOBAL_SENSOR_ID,
        now_ns // 1000,
        max(0, (now_ns - p.time_ns) // 1000),
        mavlink.GLOBAL_POSITION_SRC_VISION,
        0,
        round(p.latitude_deg * 1e7),
        round(p.longitude_deg * 1e7),
        p.height_m,
        altitude_amsl_m,
        p.horizontal_sigma_m,
        p.vertical_sigma_m,
    )


def external_position_estimate(
    e: EncodedEstimate, system_id: int, now_ns: int, since_ns: int
) -> Any:
    """MAV_CMD_EXTERNAL_POSITION_ESTIMATE (43003) to an autopilot, as COMMAND_INT (75).

    It holds the time of transmission, in seconds since since_ns, and the time between exposure and
    transmission. It has no height: ArduPilot accepts only this frame and an altitude of NaN.
    """
    p = e.position
    return mavlink.MAVLink_command_int_message(
        system_id,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        mavlink.MAV_FRAME_GLOBAL,
        mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE,
        0,
        0,
        (now_ns - since_ns) * 1e-9 % _WRAPS_S,
        max(0, now_ns - p.time_ns) * 1e-9,
        p.horizontal_sigma_m,
        NAN,
        round(p.latitude_deg * 1e7),
        round(p.longitude_deg * 1e7),
        NAN,
    )


@dataclass(frozen=True)
class HeldOutput:
    """Why a message that is due is not sent. counter: name of the counter to increment."""

    reason: Alert
    counter: str


@dataclass(frozen=True)
class EncodedMessage:
    """A message to send, and its estimate."""

    message: Any
    estimate: EncodedEstimate


@dataclass(frozen=True)
class InjectionContext:
    """Vehicle data for the injector. origin: of the EKF, None if unknown; profile: of the firmware;
    attitude_at: the autopilot's attitude at a time (ns); system_id: of the autopilot.
    """

    origin: Origin | None
    profile: FirmwareProfile
    attitude_at: Callable[[int], Attitude | None]
    system_id: int = 1


def vision_attitude(
    fix: VisionFix, time_ns: int, context: InjectionContext
) -> quat.Quaternion | None:
    """Vision's attitude, body to NED, at time_ns: the fix's, turned as the autopilot turned since
    (if that is known). None if the fix has none.
    """
    if time_ns == fix.time_ns or fix.quaternion is None:
        return fix.quaternion
    then, now = context.attitude_at(fix.time_ns), context.attitude_at(time_ns)
    if then is None or now is None:
        return fix.quaternion
    turned = quat.multiply(quat.conjugate(then.quaternion), now.quaternion)
    return quat.multiply(fix.quaternion, turned)


class MessageEncoder:
    """Encodes estimates in turn; one thread. geoid_separation_m: geoid above ellipsoid."""

    def __init__(self, config: InjectionConfig, geoid_separation_m: float, utc: SteadyUtc) -> None:
        self._config = config
        self._geoid_m = geoid_separation_m
        self._utc = utc
        self._begun_ns: int | None = None

    def make(
        self, e: EncodedEstimate, now_ns: int, context: InjectionContext
    ) -> EncodedMessage | HeldOutput:
        """The configured message; `HeldOutput` without a usable EKF origin or attitude."""
        kind = self._config.message
        altitude = e.position.height_m - self._geoid_m
        message = self._global(kind, e, altitude, now_ns, context.system_id)
        if message is not None:
            return EncodedMessage(message, e)
        if context.origin is None:
            return HeldOutput(alert(AlertId.EKF_NO_ORIGIN), "withheld_no_origin")
        ned = ned_from_origin(
            context.origin,
            e.position.latitude_deg,
            e.position.longitude_deg,
            altitude,
            context.profile.projection,
        )
        if math.hypot(*ned) > _FARTHEST_M:
            reason = alert(AlertId.EKF_ORIGIN_FAR, kilometres=math.hypot(*ned) * 1e-3)
            return HeldOutput(reason, "withheld_far_origin")
        formula = context.profile.covariance
        if kind == "odometry":
            return self._odometry(e, ned, formula, context)
        if not self._config.send_attitude:
            e = replace(e, quaternion=None)
        return EncodedMessage(vision_position_estimate(e, ned, formula), e)

    def _global(
        self,
        kind: InjectionMessage,
        e: EncodedEstimate,
        altitude_amsl_m: float,
        now_ns: int,
        system_id: int,
    ) -> Any:
        """The configured message if it has latitude and longitude; None for local ones."""
        if kind == "gps_input":
            week_ms = self._utc.gps_week_ms(e.position.time_ns)
            return gps_input(e, altitude_amsl_m, week_ms, self._config)
        if kind == "global_position_sensor":
            return global_position_sensor(e, altitude_amsl_m, now_ns)
        if kind == "external_position_estimate":
            self._begun_ns = self._begun_ns or now_ns
            return external_position_estimate(e, system_id, now_ns, self._begun_ns)
        return None

    def _odometry(
        self,
        e: EncodedEstimate,
        ned: tuple[float, float, float],
        formula: CovarianceFormula,
        context: InjectionContext,
    ) -> EncodedMessage | HeldOutput:
        """ODOMETRY; `HeldOutput` without the attitude that turns the velocity to body axes."""
        q = e.quaternion
        if q is None:
            now = context.attitude_at(e.position.time_ns)
            if now is None:
                return HeldOutput(alert(AlertId.NO_ATTITUDE), "withheld_no_attitude")
            q = now.quaternion
        frame = context.profile.odometry_frame
        return EncodedMessage(odometry(e, q, ned, formula, frame), e)
