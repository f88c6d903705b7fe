"""Estimates, reports and optionally applies the map's offset from GNSS.

Orthophotos are often metres off. While the EKF follows GNSS, the offset is a constant difference
between vision and the EKF. After the loss of GNSS it cannot be observed.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from localizer.geometry.pose import Array
from localizer.types import PoseEstimate, TrackingState
from mavlink_bridge.alerts.catalogue import alert
from mavlink_bridge.alerts.ids import AlertId
from mavlink_bridge.alerts.words import Direction, MapOffsetUse
from mavlink_bridge.bridge import Bridge
from mavlink_bridge.messages import VisionFix
from mavlink_bridge.vehicle.origin import north_east, offset
from mavlink_bridge.vehicle.sensor_errors import VEHICLE_SENSORS

_BLOCK_NS = 10_000_000_000  # differences within it are one: GNSS errors last for seconds
_LEAST_IN_BLOCK = 20
_BLOCKS = 30  # five minutes
_LEAST_BLOCKS = 6
_BIAS_FLOOR_M = 0.5  # per axis: of the receiver, for minutes, however good it says it is
_SIGNIFICANT = 11.83  # chi-square of two degrees of freedom, 99.73 %
_WAITS_NS, _WAITING = 700_000_000, 64  # until the EKF's report of the exposure is there
_LARGEST_M = 15.0  # beyond it the map is not shifted but wrong: the monitor's matter
_AGAIN_M = 2.0  # by which another estimate is reported again
_OUTLIER = 3.0  # robust sigmas of a block's median
_SLEW_M_S = 0.2  # of what is applied: far below what the EKF or the monitor take for a motion
_WINDS = tuple(Direction)

Policy = Literal["tell", "apply"]


@dataclass(frozen=True)
class MapOffset:
    """The map's offset from GNSS. ne_m: north, east, m; covariance: (2, 2), GNSS's own bias
    included; blocks: number of averages used; significant: GNSS's errors do not explain the offset.
    """

    ne_m: tuple[float, float]
    covariance: Array
    blocks: int
    significant: bool

    @property
    def direction(self) -> Direction:
        """Direction from GNSS to the map."""
        north, east = self.ne_m
        return _WINDS[round(math.degrees(math.atan2(east, north)) / 45.0) % 8]


def estimate(blocks: Array, bias_m: float) -> MapOffset:
    """Estimate the offset from blocks (N, 2): median differences vision - GNSS, north and east, m.
    Blocks more than three robust sigmas from the median are left out. bias_m: sigma of GNSS's own
    error, per axis; averaging does not reduce it.
    """
    middle = np.median(blocks, axis=0)
    spread = 1.4826 * np.median(np.abs(blocks - middle), axis=0)
    kept = np.all(np.abs(blocks - middle) <= _OUTLIER * np.maximum(spread, 0.2), axis=1)
    used = blocks[kept]
    mean = used.mean(axis=0)
    scatter = np.cov(used.T) if len(used) > 2 else np.diag(spread**2)
    P = scatter / len(used) + np.eye(2) * bias_m**2
    distance = float(mean @ np.linalg.solve(P, mean))
    return MapOffset((float(mean[0]), float(mean[1])), P, len(used), distance > _SIGNIFICANT)


class MapOffsetEstimator:
    """Estimates the map offset from fixes, and corrects fixes by it.

    It keeps its estimate when GNSS is lost. policy: "tell" if `corrected` is not used.
    gnss_is_ours: whether the vehicle's GNSS is our own GPS_INPUT, which is no evidence.
    """

    def __init__(
        self,
        vehicle: Bridge,
        policy: Policy,
        event: Callable[[str, str], None],
        *,
        gnss_is_ours: bool = False,
    ) -> None:
        self._vehicle, self._policy, self._event = vehicle, policy, event
        self._gnss_is_ours = gnss_is_ours
        self._lock = threading.Lock()
        self._waiting: deque[VisionFix] = deque(maxlen=_WAITING)
        self._block: list[tuple[float, float]] = []
        self._block_ns = 0
        self._blocks: deque[Array] = deque(maxlen=_BLOCKS)
        self._shift: MapOffset | None = None
        self._reported: tuple[float, float] | None = None
        self._applied = np.zeros(2)
        self._applied_ns: int | None = None

    @property
    def shift(self) -> MapOffset | None:
        """The newest estimate; None before there is one."""
        with self._lock:
            return self._shift

    def report(self) -> dict[str, float | bool] | None:
        """Estimate and applied offset for the health report; None before there is an estimate."""
        with self._lock:
            shift, applied = self._shift, self._applied.copy()
        if shift is None:
            return None
        return {
            "north_m": shift.ne_m[0],
            "east_m": shift.ne_m[1],
            "sigma_m": float(np.sqrt(np.linalg.eigvalsh(shift.covariance)[-1])),
            "blocks": shift.blocks,
            "significant": shift.significant,
            "applied_north_m": float(applied[0]),
            "applied_east_m": float(applied[1]),
        }

    def add_fix(self, seen: PoseEstimate, fix: VisionFix) -> None:
        """Add an uncorrected fix, to be compared with GNSS 0.7 s later (only while TRACKING). seen:
        its estimate.
        """
        if seen.state is TrackingState.TRACKING and not self._gnss_is_ours:
            self._waiting.append(fix)
        while self._waiting and fix.time_ns - self._waiting[0].time_ns >= _WAITS_NS:
            self._learn(self._waiting.popleft())

    def _learn(self, fix: VisionFix) -> None:
        place = self._vehicle.gnss_place_at(fix.time_ns)
        if place is None:
            self._block = []
            return
        if not self._block:
            self._block_ns = fix.time_ns
        self._block.append(north_east(place[0], place[1], fix.latitude_deg, fix.longitude_deg))
        if fix.time_ns - self._block_ns < _BLOCK_NS:
            return
        block, self._block = np.array(self._block), []
        if len(block) < _LEAST_IN_BLOCK:
            return
        self._blocks.append(np.median(block, axis=0))
        if len(self._blocks) >= _LEAST_BLOCKS:
            accuracy = self._vehicle.state().gps_h_accuracy_m or VEHICLE_SENSORS.gnss_m
            bias_m = max(_BIAS_FLOOR_M, accuracy)  # receivers are optimistic: not over root two
            self._note(estimate(np.array(self._blocks), bias_m))

    def _note(self, shift: MapOffset) -> None:
        with self._lock:
            self._shift = shift
        if not shift.significant or math.hypot(*shift.ne_m) > _LARGEST_M:
            return
        reported = self._reported
        if reported is not None and math.dist(reported, shift.ne_m) < _AGAIN_M:
            return
        self._reported = shift.ne_m
        applied = MapOffsetUse.APPLIED if self._policy == "apply" else MapOffsetUse.REPORTED
        self._vehicle.report_alert(
            alert(AlertId.MAP_OFFSET, metres=math.hypot(*shift.ne_m), direction=shift.direction,
                  applied=applied)
        )  # fmt: skip
        north, east = shift.ne_m
        self._event(
            "info",
            f"map shift: {north:+.2f} m north, {east:+.2f} m east, sigma "
            f"{math.sqrt(shift.covariance[0, 0]):.2f} and {math.sqrt(shift.covariance[1, 1]):.2f}"
            f" m, {shift.blocks} blocks",
        )

    def corrected(self, fix: VisionFix) -> VisionFix:
        """The fix corrected by the applied offset, which follows a significant estimate slowly, to
        avoid jumps.
        """
        shift = self._shift
        usable = shift is not None and shift.significant and math.hypot(*shift.ne_m) <= _LARGEST_M
        if shift is not None and usable:
            last_ns = fix.time_ns if self._applied_ns is None else self._applied_ns
            reach = _SLEW_M_S * min(max((fix.time_ns - last_ns) * 1e-9, 0.0), 1.0)
            way = np.array(shift.ne_m) - self._applied
            length = float(np.linalg.norm(way))
            with self._lock:
                self._applied = self._applied + way * min(1.0, reach / max(length, 1e-9))
            self._applied_ns = fix.time_ns
        if shift is None or not self._applied.any():
            return fix
        latitude, longitude = offset(
            fix.latitude_deg, fix.longitude_deg, -float(self._applied[0]), -float(self._applied[1])
        )
        covariance = fix.position_covariance_ned.copy()
        covariance[:2, :2] += shift.covariance
        return replace(
            fix,
            latitude_deg=latitude,
            longitude_deg=longitude,
            position_covariance_ned=covariance,
        )
