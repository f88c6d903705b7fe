"""Keeps the last confirmed position in a small file, from which a restart in flight continues.

The EKF's displacement since then is added. The file is not used if it is older than
`prior.recall_s`, from another boot of this computer, or the EKF's displacement is unknown; the
position is then searched.
"""

from __future__ import annotations

import json
import logging
import math
import os
import stat
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, TypeAdapter

from companion.conversions import CameraExtrinsics
from companion.ending import wait_for_end
from companion.flight.priors import AutopilotPose, drift_sigma_m
from localizer.geometry.geo import NED_FROM_ENU
from localizer.geometry.pose import Pose
from localizer.sensors.error_model import SENSORS
from localizer.types import PoseEstimate, PosePrior, ReferenceBundle, TrackingState
from mavlink_bridge.atomic_file import read_small_file, replace_file
from mavlink_bridge.link.clock import boot_id
from mavlink_bridge.messages import Origin, VehicleState

_log = logging.getLogger(__name__)
_WRITE_S = 0.5
_RECALL_S = 20.0  # oldest confirmed position that a restart uses
_FASTEST_MPS = 40.0  # a way beyond it is a jump of the EKF
_LEAST_SIGMA_M = 0.5
_FARTHEST_M = 1e6
_CLOCK_NS = 500_000_000  # by which the first measurement of the autopilot's clock may be off
_SAME_DEG, _SAME_M = 1e-6, 0.1  # of an origin that is read again
LocalAt = Callable[[int], tuple[float, ...] | None]
_Metres = Annotated[float, Field(gt=-_FARTHEST_M, lt=_FARTHEST_M)]


@dataclass(frozen=True)
class LastFix:
    """A confirmed position, as it is stored for a restart.

    boot: id of this computer's boot; time_ns: CLOCK_MONOTONIC of that boot. latitude_deg,
    longitude_deg, height_m: of the camera, WGS84; sigma_m: of its worst axis. local_ned: the EKF's
    position at that time, m; autopilot_ns: time since the autopilot's boot; origin: of local_ned,
    latitude, longitude, altitude AMSL; None where unknown.
    """

    boot: str
    time_ns: Annotated[int, Field(ge=0, lt=1 << 63)]
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    height_m: _Metres
    sigma_m: Annotated[float, Field(gt=0.0, lt=_FARTHEST_M)]
    local_ned: tuple[_Metres, _Metres, _Metres]
    autopilot_ns: int | None = None
    origin: tuple[float, float, float] | None = None

    def has_same_origin(self, state: VehicleState, time_ns: int) -> bool:
        """Whether the EKF still uses the same origin at time_ns (CLOCK_MONOTONIC): False after a
        reboot of the autopilot, or if the origin was moved; True if nothing tells. state: newest.
        """
        offset_ns, origin = state.clock_offset_ns, _place(state.origin)
        since = None if offset_ns is None else time_ns - offset_ns + _CLOCK_NS
        if since is not None and since < (self.autopilot_ns or 0):
            return False
        if self.origin is None or origin is None:
            return True
        pairs = zip(self.origin, origin, (_SAME_DEG, _SAME_DEG, _SAME_M), strict=True)
        return all(abs(a - b) <= most for a, b, most in pairs)


_STORED = TypeAdapter(LastFix)


def _place(origin: Origin | None) -> tuple[float, float, float] | None:
    if origin is None:
        return None
    return origin.latitude_deg, origin.longitude_deg, origin.altitude_amsl_m


def read_last_fix(path: Path, boot: str) -> LastFix | None:
    """The position in the file, if a process of this boot (id `boot`) wrote it; None otherwise. If
    the file is there but unreadable, implausible or writable by others, the log says so.
    """
    try:
        status = os.lstat(path)
        if not stat.S_ISREG(status.st_mode):  # a pipe would be waited for
            _log.warning("%s is no plain file: ignored", path)
            return None
        if status.st_uid != os.geteuid() or status.st_mode & 0o022:
            _log.warning("%s may be written by others: ignored", path)
            return None
        found = _STORED.validate_json(read_small_file(path))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        _log.warning("%s cannot be used: %s", path, error)
        return None
    return found if boot and found.boot == boot else None


class FixMemory:
    """Writes the newest confirmed position twice a second, and gives a prior from that of the
    previous process.

    path: the file, None for none. trusted: whether no check holds the output now; state: the
    vehicle's telemetry. Thread-safe; its own thread writes the file.
    """

    def __init__(
        self,
        path: Path | None,
        autopilot: AutopilotPose,
        extrinsics: CameraExtrinsics,
        local_at: LocalAt,
        trusted: Callable[[], bool] = lambda: True,
        state: Callable[[], VehicleState] = VehicleState,
    ) -> None:
        self._path = path
        self._autopilot, self._extrinsics = autopilot, extrinsics
        self._local_at, self._trusted, self._state = local_at, trusted, state
        self._boot = boot_id()
        self._before = None if path is None else read_last_fix(path, self._boot)
        self._newest: PoseEstimate | None = None
        self._failed = self._leaves = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="last-fix", daemon=True)

    def start(self) -> None:
        """Start the thread that writes the file."""
        self._thread.start()

    def hand_over(self) -> None:
        """Make `stop` keep the file, for the process that follows."""
        self._leaves = True

    def stop(self) -> None:
        """Stop the thread; remove the file unless `hand_over` was called or the disk hangs."""
        self._stop.set()
        if wait_for_end(self._thread) and self._path is not None and not self._leaves:
            try:
                self._path.unlink(missing_ok=True)
            except OSError as error:  # its age and the boot still tell the next process
                _log.warning("the last fix is not removed: %s", error)

    def add_estimate(self, estimate: PoseEstimate, _: ReferenceBundle) -> None:
        """Take a position that the map confirmed, to be written if it is trusted then; forget the
        previous process's. Other estimates are ignored. Never blocks.
        """
        if estimate.accepted and estimate.state is TrackingState.TRACKING:
            self._newest, self._before = estimate, None

    def prior(self, time_ns: int) -> PosePrior | None:
        """Prior of the camera for time_ns (CLOCK_MONOTONIC) by the previous process's position and
        the EKF's displacement since. None while attitude or displacement is unknown, and from then
        on if it is too old, if the EKF jumped, or if this process has found a position itself.
        """
        last = self._before
        if last is None:
            return None
        age_s = (time_ns - last.time_ns) * 1e-9
        if not 0.0 <= age_s <= _RECALL_S:
            self._before = None
            return None
        local, rotation = self._local_at(time_ns), self._autopilot.rotation(time_ns)
        if local is None or rotation is None:
            return None
        if not last.has_same_origin(self._state(), time_ns):
            self._before = None
            return None
        way = np.array(local[:3]) - np.array(last.local_ned)
        if float(np.linalg.norm(way)) > _FASTEST_MPS * age_s + 1.0:
            self._before = None
            return None
        begun = self._extrinsics.frame.enu_from_geodetic(
            last.latitude_deg, last.longitude_deg, last.height_m
        )
        sigma_m = math.hypot(max(last.sigma_m, _LEAST_SIGMA_M), drift_sigma_m(age_s))
        pose = Pose(rotation, np.asarray(begun) + NED_FROM_ENU.T @ way)
        prior = PosePrior.around(pose, sigma_m, SENSORS.heading_deg, time_ns)
        return PosePrior(
            pose, prior.covariance, time_ns, self._autopilot.velocity, independent=True
        )

    def _run(self) -> None:
        while not self._stop.wait(_WRITE_S):
            newest, self._newest = self._newest, None
            if newest is None or self._path is None or not self._trusted():
                continue
            try:
                self._write(newest, self._path)
                self._failed = False
            except Exception as error:  # a full disk, a covariance that is none: flight goes on
                if not self._failed:
                    _log.warning("the last fix is not kept: %s: %s", self._path, error)
                self._failed = True

    def _write(self, estimate: PoseEstimate, path: Path) -> None:
        """Replace the file atomically. No fsync: after a power loss the boot id differs anyway."""
        local = self._local_at(estimate.exposure_time_ns)
        if local is None:
            return
        place = self._extrinsics.frame.position(estimate.world_from_camera.translation)
        state, time_ns = self._state(), estimate.exposure_time_ns
        offset_ns = state.clock_offset_ns
        row = LastFix(
            self._boot, time_ns, place.latitude_deg, place.longitude_deg,
            place.height_m, float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1])),
            (local[0], local[1], local[2]), None if offset_ns is None else time_ns - offset_ns,
            _place(state.origin),
        )  # fmt: skip
        replace_file(path, json.dumps(asdict(row)))
