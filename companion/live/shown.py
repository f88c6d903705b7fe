"""Data for the console: state documents, load of this computer, and frames with their poses.

The flight's threads only store references; the publisher's thread formats the data.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.targets.target_manager import TargetEstimate
from companion.writing import json_value
from localizer.geometry.geo import LocalFrame
from localizer.geometry.pose import Pose, quaternion_from_matrix
from localizer.types import Frame, PoseEstimate, ReferenceBundle, RenderedView
from mavlink_bridge.alerts.catalogue import body
from mavlink_bridge.injection.outcome import LoopVerdict
from mavlink_bridge.injection.shadow import ShadowScore
from mavlink_bridge.messages import VehicleState
from mavlink_bridge.vehicle.mission import MissionWaypoint

_ZONES = Path("/sys/class/thermal")
_HOT_READS_S = 5.0


class MachineLoad:
    """Measures the load of this process and of the machine."""

    def __init__(self) -> None:
        self._before = (time.monotonic(), self._used_s())
        self._temperature: tuple[float, float | None] = (-_HOT_READS_S, None)

    def read(self) -> dict[str, float | None]:
        """cpu_percent: of this process since the last call, 100 for one core; cores: their number;
        load: one-minute average; temperature_c: warmest zone, degrees Celsius, None if unknown.
        """
        now, used = time.monotonic(), self._used_s()
        elapsed = max(now - self._before[0], 1e-3)
        share = 100.0 * (used - self._before[1]) / elapsed
        self._before = (now, used)
        if now - self._temperature[0] >= _HOT_READS_S:
            self._temperature = (now, warmest_c())
        return {
            "cpu_percent": share,
            "cores": float(os.cpu_count() or 1),
            "load": os.getloadavg()[0],
            "temperature_c": self._temperature[1],
        }

    @staticmethod
    def _used_s() -> float:
        times = os.times()
        return times.user + times.system


def warmest_c() -> float | None:
    """Temperature of the warmest thermal zone, degrees Celsius; None if none can be read."""
    found = []
    for path in _ZONES.glob("thermal_zone*/temp"):
        try:
            found.append(int(path.read_text()) / 1000.0)
        except (OSError, ValueError):
            continue
    return max(found, default=None)


_FRAMES = 12  # pictures that wait for their estimate: a second or so
_WIDEST = 960  # pixels that are sent
_FRESH_NS = 60_000_000  # a picture that waited longer for its turn is not given out any more
_EVENTS = 300
_TARGETS = 64


@dataclass(frozen=True)
class Instruments:
    """Functions that give the data of a state document. verdict: whether the EKF follows vision,
    None if not tested; injecting: whether positions are sent now; mission: the autopilot's
    waypoints.
    """

    health: Callable[[], dict[str, Any]]
    vehicle: Callable[[], VehicleState]
    shadow: Callable[[], ShadowScore]
    verdict: Callable[[], LoopVerdict | None]
    injecting: Callable[[], bool]
    mission: Callable[[], tuple[MissionWaypoint, ...]] = tuple


@dataclass(frozen=True)
class ConsoleFrame:
    """A frame for the console. head: JSON object (time, camera, pose); parts: image (h, w, 3) uint8
    and, with a map view, its rgb (h, w, 3) uint8 and depth (h, w) float32, m.
    """

    head: dict[str, Any]
    parts: tuple[np.ndarray, ...]


class ConsoleData:
    """Keeps the newest data for the console. frame: map coordinates; geoid_m: geoid above the
    ellipsoid; about: constants of a flight (mode, limits, map), for the first message.
    """

    def __init__(
        self, frame: LocalFrame, geoid_m: float, instruments: Instruments, about: dict[str, Any]
    ) -> None:
        self._frame, self._geoid_m = frame, geoid_m
        self._instruments, self._about = instruments, about
        self._load = MachineLoad()
        self._lock = threading.Lock()
        self._pictures: OrderedDict[int, Frame] = OrderedDict()
        self._paired: tuple[Frame, PoseEstimate | None, RenderedView | None] | None = None
        self._paired_ns = 0
        self._estimate: PoseEstimate | None = None
        self._targets: OrderedDict[str, TargetEstimate] = OrderedDict()
        self._events: deque[tuple[int, int, str, str]] = deque(maxlen=_EVENTS)
        self._count = 0

    # --- from the flight's threads; none of them waits ----------------------------------------

    def add_frame(self, frame: Frame) -> None:
        """Keep a frame until its estimate arrives; at most the 12 newest."""
        with self._lock:
            self._pictures[frame.exposure_time_ns] = frame
            while len(self._pictures) > _FRAMES:
                self._pictures.popitem(last=False)

    def add_estimate(self, estimate: PoseEstimate, bundle: ReferenceBundle | None) -> None:
        """Pair an estimate with its frame, if that was kept. bundle: its map view, or None."""
        self._estimate = estimate
        with self._lock:
            frame = self._pictures.pop(estimate.exposure_time_ns, None)
            if frame is not None:
                self._paired = (frame, estimate, None if bundle is None else bundle.view)
                self._paired_ns = time.monotonic_ns()

    def add_target(self, target: TargetEstimate) -> None:
        """Keep the newest fix of each target; at most 64 targets."""
        with self._lock:
            self._targets[target.fix.target_id] = target
            self._targets.move_to_end(target.fix.target_id)
            while len(self._targets) > _TARGETS:
                self._targets.popitem(last=False)

    def forget_target(self, name: str) -> None:
        """Remove a target that ended. name: its target_id."""
        with self._lock:
            self._targets.pop(name, None)

    def add_event(self, level: str, text: str) -> None:
        """Add an event, such as an alert, for the page's list. level: "info" or "warning"."""
        with self._lock:
            self._count += 1
            self._events.append((self._count, time.monotonic_ns(), level, text))

    # --- for the link's thread ----------------------------------------------------------------

    def first_message(self) -> dict[str, Any]:
        """The first message for a console: constants of the flight, and the time."""
        return {"kind": "hello", **self._about, "monotonic_ns": time.monotonic_ns()}

    def state(self, last_event: int) -> tuple[dict[str, Any], int]:
        """A state document, and the number of its newest event. It holds the events after number
        `last_event`.
        """
        with self._lock:
            events = [e for e in self._events if e[0] > last_event]
            targets = list(self._targets.values())
            count = self._count
        vehicle, shadow = self._instruments.vehicle(), self._instruments.shadow()
        verdict = self._instruments.verdict()
        document = {
            "kind": "state",
            "time_ns": time.monotonic_ns(),
            "utc_ns": time.time_ns(),
            "health": self._instruments.health(),
            "vehicle": asdict(vehicle),
            "shadow": asdict(shadow) | {"line": shadow.line()},
            "follows": None if verdict is None else _follows(verdict),
            "injecting": self._instruments.injecting(),
            "estimate": self._estimate and self._position(self._estimate),
            "gnss_residual_m": self._gnss_residual_m(vehicle),
            "mission": [
                [w.number, w.latitude_deg, w.longitude_deg] for w in self._instruments.mission()
            ],
            "targets": [self._target(t) for t in targets],
            # Asked on the link's own thread, which it times: what the console costs the flight.
            "machine": self._load.read() | {"console_link_s": time.thread_time()},
            "events": [
                {"number": n, "time_ns": t, "level": level, "text": text}
                for n, t, level, text in events
            ],
        }
        plain: dict[str, Any] = json_value(document)
        return plain, count

    def take_frame(self) -> ConsoleFrame | None:
        """The newest frame with its pose and map view. None if it was taken before, or has waited
        longer than 60 ms. If nothing was localized for 1 s, the newest frame without a pose.
        """
        with self._lock:
            paired, self._paired = self._paired, None
            if paired is not None and time.monotonic_ns() - self._paired_ns > _FRESH_NS:
                return None  # it was not due then; the next is near
            if paired is None and self._pictures and self._is_unlocalized():
                _, frame = self._pictures.popitem(last=True)
                paired = (frame, None, None)
        if paired is None:
            return None
        frame, estimate, view = paired
        image = _downscaled(frame.image)
        head: dict[str, Any] = {
            "kind": "frame",
            "exposure_ns": frame.exposure_time_ns,
            "published_ns": time.monotonic_ns(),
            "image": [image.shape[1], image.shape[0]],
            "camera": frame.camera.to_dict(),
            "estimate": None,
            "view": None,
        }
        parts = [image]
        if estimate is not None:
            head["estimate"] = self._position(estimate) | {
                "pose": pose_data(estimate.world_from_camera)
            }
            if view is not None and estimate.accepted:
                head["view"] = {
                    "camera": view.camera.to_dict(), "pose": pose_data(view.world_from_camera)
                }  # fmt: skip
                parts += [view.rgb, view.depth]
        return ConsoleFrame(json_value(head), tuple(parts))

    def _is_unlocalized(self) -> bool:
        newest = self._estimate
        return newest is None or time.monotonic_ns() - newest.exposure_time_ns > 1_000_000_000

    def _position(self, estimate: PoseEstimate) -> dict[str, Any]:
        pose = estimate.world_from_camera
        at = self._frame.position(pose.translation)
        forward = pose.rotation[:, 2]
        up = -pose.rotation[:, 1]
        ahead = forward if abs(forward[2]) < 0.98 else up  # looking down, the picture's top
        return {
            "time_ns": estimate.exposure_time_ns,
            "latitude_deg": at.latitude_deg,
            "longitude_deg": at.longitude_deg,
            "height_m": at.height_m,
            "amsl_m": at.height_m - self._geoid_m,
            "enu_m": [float(x) for x in pose.translation],
            "heading_deg": math.degrees(math.atan2(ahead[0], ahead[1])) % 360.0,
            "covariance_m2": estimate.covariance[:2, :2].tolist(),
            "sigma_m": float(np.sqrt(max(np.linalg.eigvalsh(estimate.covariance[:2, :2])[-1], 0))),
            "sigma_up_m": float(np.sqrt(max(estimate.covariance[2, 2], 0.0))),
            "state": estimate.state.value,
            "status": estimate.status.name,
            "accepted": estimate.accepted,
            "quality": estimate.quality,
            "last_fix_ns": estimate.last_fix_ns,
            "stages_ms": dict(estimate.stage_ms),
        }

    def _gnss_residual_m(self, vehicle: VehicleState) -> float | None:
        """Horizontal distance from the newest fix to the GNSS receiver's position, m; None without
        either. It contains the receiver's delay times the speed.
        """
        estimate = self._estimate
        if estimate is None or not estimate.accepted or vehicle.gps_fix_type < 3:
            return None
        if vehicle.gps_latitude_deg is None or vehicle.gps_longitude_deg is None:
            return None
        height = self._frame.origin.height_m
        place = (vehicle.gps_latitude_deg, vehicle.gps_longitude_deg, height)
        gnss = self._frame.enu_from_geodetic(*place)
        return float(np.hypot(*(estimate.world_from_camera.translation - gnss)[:2]))

    def _target(self, target: TargetEstimate) -> dict[str, Any]:
        fix = target.fix
        at = self._frame.position(fix.position_world)
        return {
            "name": fix.target_id,
            "time_ns": fix.exposure_time_ns,
            "latitude_deg": at.latitude_deg,
            "longitude_deg": at.longitude_deg,
            "height_m": at.height_m,
            "amsl_m": at.height_m - self._geoid_m,
            "covariance_m2": fix.covariance[:2, :2].tolist(),
            "sigma_m": float(np.sqrt(max(fix.covariance[0, 0] + fix.covariance[1, 1], 0.0))),
            "sigma_up_m": float(np.sqrt(max(fix.covariance[2, 2], 0.0))),
            "elsewhere": fix.elsewhere,
            "pixel": None if fix.pixel is None else [float(x) for x in fix.pixel],
            "velocity_m_s": None if fix.velocity is None else [*map(float, fix.velocity)],
        }


def pose_data(pose: Pose) -> dict[str, list[float]]:
    """A pose as JSON data: quaternion (w, x, y, z) and translation, m."""
    return {
        "q": [float(x) for x in quaternion_from_matrix(pose.rotation)],
        "t": [float(x) for x in pose.translation],
    }


def _downscaled(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    if width <= _WIDEST:
        return np.ascontiguousarray(image)
    size = (_WIDEST, round(height * _WIDEST / width))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def _follows(verdict: LoopVerdict) -> dict[str, Any]:
    reason = "" if verdict.reason is None else body(verdict.reason)
    return asdict(verdict) | {"reason": reason}
