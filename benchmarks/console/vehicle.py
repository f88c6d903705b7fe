"""A vehicle that flies a recorded sequence again, over MAVLink: what `companion run` listens to."""

from __future__ import annotations

import csv
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry import GIMBAL_FROM_CAMERA
from companion.sources.folder_source import TIMESTAMPS_NAME, list_images, read_timestamps
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import Pose, quaternion_from_matrix
from localizer.geometry.posefile import read_poses, world_from_camera

_STEP_S = 0.04
_HEARTBEAT = 10  # steps
_ARMED = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_SAFETY_ARMED


@dataclass(frozen=True)
class FirstFrames:
    """The first frames of a sequence. times_ns: since the first; poses: world_from_camera."""

    images: tuple[Path, ...]
    times_ns: np.ndarray
    poses: tuple[Pose, ...]
    positions: tuple[Geodetic, ...]

    @classmethod
    def read(cls, folder: Path, frame: LocalFrame, frames: int) -> FirstFrames:
        """Images, their times and the truth, in the map's frame."""
        images = tuple(list_images(folder / "images")[:frames])
        stamps = read_timestamps(folder / "images" / TIMESTAMPS_NAME)
        times = np.array([stamps[path.name] for path in images], dtype=np.int64)
        rows = {row.name: row for row in read_poses(folder / "poses.txt")}
        truth = [rows[path.name] for path in images]
        return cls(
            images, times - times[0], tuple(world_from_camera(r, frame) for r in truth),
            tuple(row.position for row in truth),
        )  # fmt: skip

    @property
    def length_s(self) -> float:
        """From the first exposure to the last."""
        return float(self.times_ns[-1] * 1e-9)

    def write_images(self, folder: Path) -> None:
        """A folder of these images alone, for `companion run`."""
        folder.mkdir(parents=True)
        lines = []
        for path, time_ns in zip(self.images, self.times_ns, strict=True):
            (folder / path.name).symlink_to(path.resolve())
            lines.append(f"{path.name} {time_ns}\n")
        (folder / TIMESTAMPS_NAME).write_text("".join(lines))


class ReplayVehicle:
    """Sends heartbeat, attitude, position, GNSS and gimbal. begun_ns: when the first image was
    exposed, CLOCK_MONOTONIC, or None while that is not known: it stands until then.
    """

    def __init__(
        self, port: int, sequence: FirstFrames, geoid_m: float, begun_ns: Callable[[], int | None]
    ) -> None:
        self._to, self._sequence, self._geoid_m = ("127.0.0.1", port), sequence, geoid_m
        self._begun_ns = begun_ns
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._codec = mavlink.MAVLink(None, 1, 1)
        self._boot_ns = time.monotonic_ns() - 60 * 10**9
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="vehicle", daemon=True)

    def __enter__(self) -> ReplayVehicle:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        count = 0
        while not self._over.wait(_STEP_S):
            begun_ns, index = self._begun_ns(), 0
            if begun_ns is not None:
                passed = time.monotonic_ns() - begun_ns
                last = len(self._sequence.poses) - 1
                index = min(int(np.searchsorted(self._sequence.times_ns, passed)), last)
            self._tell(index, count)
            count += 1

    def _tell(self, index: int, count: int) -> None:
        ms = (time.monotonic_ns() - self._boot_ns) // 1_000_000
        at = self._sequence.positions[index]
        place = (
            round(at.latitude_deg * 1e7), round(at.longitude_deg * 1e7),
            round((at.height_m - self._geoid_m) * 1e3),
        )  # fmt: skip
        ned_from_gimbal = NED_FROM_ENU @ self._sequence.poses[index].rotation @ GIMBAL_FROM_CAMERA.T
        q = [float(x) for x in quaternion_from_matrix(ned_from_gimbal)]
        earth = mavlink.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
        if count % _HEARTBEAT == 0:
            kind, autopilot = mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
            self._send(mavlink.MAVLink_heartbeat_message(kind, autopilot, _ARMED, 4, 4, 3))
        self._send(mavlink.MAVLink_attitude_message(ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self._send(mavlink.MAVLink_global_position_int_message(ms, *place, 0, 0, 0, 0, 0))
        self._send(
            mavlink.MAVLink_gps_raw_int_message(
                ms * 1000, 3, *place, 80, 80, 0, 0, 12, h_acc=800, v_acc=1200
            )
        )
        self._send(
            mavlink.MAVLink_gimbal_device_attitude_status_message(
                0, 0, ms, earth, q, 0.0, 0.0, 0.0, 0
            )
        )

    def _send(self, message: mavlink.MAVLink_message) -> None:
        self._socket.sendto(message.pack(self._codec), self._to)
        self._codec.seq = (self._codec.seq + 1) % 256


def begun_ns(record: Path, sequence: FirstFrames) -> int | None:
    """When the first image was exposed, by the first row of the record; None before it stands."""
    try:
        with (record / "estimates.csv").open(newline="", encoding="utf-8") as file:
            row = next(csv.DictReader(file), None)
            if row is None or None in row.values():
                return None
            first = int(row["exposure_time_ns"])
            return first - int(sequence.times_ns[int(row["sequence"])])
    except (OSError, KeyError, ValueError, TypeError):
        return None
