"""From an estimate to the configured message, or to the reason why there can be none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from mavlink_bridge import quaternion as quat
from mavlink_bridge.alerts.alert import Alert
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.config import InjectionConfig, InjectionMessage
from mavlink_bridge.injection.encode import (
    Angles,
    EncodedEstimate,
    external_position_estimate,
    global_position_sensor,
    gps_input,
    odometry,
    vision_position_estimate,
)
from mavlink_bridge.link.clock import SteadyUtc
from mavlink_bridge.messages import Attitude, Origin, VisionFix
from mavlink_bridge.vehicle.origin import ned_from_origin
from mavlink_bridge.vehicle.profile import CovarianceFormula, FirmwareProfile

_FARTHEST_M = 100_000.0  # from the origin: farther, one of the two is wrong


@dataclass(frozen=True)
class HeldOutput:
    """Why nothing is sent although it is time. counter: the name it is counted under."""

    reason: Alert
    counter: str


@dataclass(frozen=True)
class EncodedMessage:
    """One message to send, and the estimate it was made from."""

    message: Any
    estimate: EncodedEstimate


@dataclass(frozen=True)
class InjectionContext:
    """What the injector must know about the vehicle. now: the origin and profile of this moment."""

    origin: Origin | None
    profile: FirmwareProfile
    attitude_at: Callable[[int], Attitude | None]
    system_id: int = 1


def attitude_of(fix: VisionFix, time_ns: int, context: InjectionContext) -> Angles:
    """Vision attitude at time_ns: the fix's, turned as the autopilot turned since."""
    angles = (fix.roll_rad, fix.pitch_rad, fix.yaw_rad)
    known = _all_known(angles)
    if time_ns == fix.time_ns or known is None:
        return angles
    then, now = context.attitude_at(fix.time_ns), context.attitude_at(time_ns)
    if then is None or now is None:
        return angles
    turned = quat.multiply(quat.conjugate(then.quaternion), now.quaternion)
    return quat.to_euler(quat.multiply(quat.from_euler(*known), turned))


def _all_known(angles: Angles) -> tuple[float, float, float] | None:
    roll, pitch, yaw = angles
    return None if roll is None or pitch is None or yaw is None else (roll, pitch, yaw)


class MessageMaker:
    """Makes one message at a time of estimates; one thread."""

    def __init__(self, config: InjectionConfig, geoid_separation_m: float, utc: SteadyUtc) -> None:
        self._config = config
        self._geoid_m = geoid_separation_m
        self._utc = utc
        self._begun_ns: int | None = None

    def make(
        self, e: EncodedEstimate, now_ns: int, context: InjectionContext
    ) -> EncodedMessage | HeldOutput:
        """The configured message of an estimate."""
        kind: InjectionMessage = self._config.message
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
        if self._config.covariance != "profile":
            formula = self._config.covariance
        if kind == "odometry":
            return self._odometry(e, ned, formula, context)
        if not self._config.send_attitude:
            e = replace(e, attitude=(None, None, None))
        return EncodedMessage(vision_position_estimate(e, ned, formula), e)

    def _global(
        self,
        kind: InjectionMessage,
        e: EncodedEstimate,
        altitude_amsl_m: float,
        now_ns: int,
        system_id: int,
    ) -> Any:
        """The message where it has a latitude and a longitude; None for local ones."""
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
        """Velocity is rotated by the message's quaternion, so there must be one."""
        attitude = _all_known(e.attitude)
        if attitude is None:
            now = context.attitude_at(e.position.time_ns)
            if now is None:
                return HeldOutput(alert(AlertId.NO_ATTITUDE), "withheld_no_attitude")
            attitude = (now.roll_rad, now.pitch_rad, now.yaw_rad)
            e = replace(e, attitude=attitude)
        frame = context.profile.odometry_frame
        return EncodedMessage(odometry(e, attitude, ned, formula, frame), e)
