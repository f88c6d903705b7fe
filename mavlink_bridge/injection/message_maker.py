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
    EncodedEstimate,
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


def attitude_of(fix: VisionFix, time_ns: int, context: InjectionContext) -> quat.Quaternion | None:
    """Vision attitude at time_ns: the fix's, turned as the autopilot turned since."""
    if time_ns == fix.time_ns or fix.quaternion is None:
        return fix.quaternion
    then, now = context.attitude_at(fix.time_ns), context.attitude_at(time_ns)
    if then is None or now is None:
        return fix.quaternion
    turned = quat.multiply(quat.conjugate(then.quaternion), now.quaternion)
    return quat.multiply(fix.quaternion, turned)


class MessageMaker:
    """Makes one message at a time of estimates; one thread."""

    def __init__(self, config: InjectionConfig, geoid_separation_m: float, utc: SteadyUtc) -> None:
        self._config = config
        self._geoid_m = geoid_separation_m
        self._utc = utc

    def make(
        self, e: EncodedEstimate, now_ns: int, context: InjectionContext
    ) -> EncodedMessage | HeldOutput:
        """The configured message of an estimate."""
        kind: InjectionMessage = self._config.message
        altitude = e.position.height_m - self._geoid_m
        if kind == "gps_input":
            week_ms = self._utc.gps_week_ms(e.position.time_ns)
            return EncodedMessage(gps_input(e, altitude, week_ms, self._config), e)
        if kind == "global_position_sensor":
            return EncodedMessage(global_position_sensor(e, altitude, now_ns), e)
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
            e = replace(e, quaternion=None)
        return EncodedMessage(vision_position_estimate(e, ned, formula), e)

    def _odometry(
        self,
        e: EncodedEstimate,
        ned: tuple[float, float, float],
        formula: CovarianceFormula,
        context: InjectionContext,
    ) -> EncodedMessage | HeldOutput:
        """Velocity is rotated by the message's quaternion, so there must be one."""
        q = e.quaternion
        if q is None:
            now = context.attitude_at(e.position.time_ns)
            if now is None:
                return HeldOutput(alert(AlertId.NO_ATTITUDE), "withheld_no_attitude")
            q = now.quaternion
        frame = context.profile.odometry_frame
        return EncodedMessage(odometry(e, q, ned, formula, frame), e)
