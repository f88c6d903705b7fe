"""A zoom lens: its effect on the image, and the zoom level that the camera reports.

Its focal length rises evenly with the level, which no table of a few points has exactly.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import cv2
import numpy as np
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from localizer.geometry.camera import Camera
from localizer.types import Image
from sitl.ground.link import disable_reconnect
from sitl.ground.vehicle_record import VEHICLE

MOST = 2.0  # focal length at level 100 over that at level 0
_CAMERA = mavlink.MAV_COMP_ID_CAMERA
_PERIOD_S = 0.1


@dataclass(frozen=True)
class Zooming:
    """A change of the focal length (multiples of the shortest) between two times."""

    before: float
    after: float
    begin_ns: int
    end_ns: int

    def at(self, time_ns: int) -> float:
        """Focal length at a time, as a multiple of the shortest."""
        span = [self.begin_ns, max(self.end_ns, self.begin_ns + 1)]
        return float(np.interp(time_ns, span, [self.before, self.after]))


def level_of(factor: float) -> float:
    """Zoom level (per cent of the range) that CAMERA_SETTINGS reports at a focal length. factor:
    focal length divided by the shortest one.
    """
    return 100.0 * (factor - 1.0) / (MOST - 1.0)


class ZoomLens:
    """Simulates a longer focal length: crops the middle of the image and enlarges it."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._zooming: Zooming | None = None

    def set(self, zooming: Zooming) -> None:
        """Set the change of the focal length."""
        self._zooming = zooming

    def apply(self, image: Image, time_ns: int) -> Image:
        """The zoomed image (H, W, 3) uint8 of an exposure, enlarged about the principal point."""
        factor = 1.0 if self._zooming is None else self._zooming.at(time_ns)
        if factor == 1.0:
            return image
        # Pixel centres lie at (u + 0.5, v + 0.5), those of OpenCV at (u, v).
        centre = np.array([self._camera.cx - 0.5, self._camera.cy - 0.5])
        matrix = np.column_stack([np.eye(2) * factor, centre * (1.0 - factor)])
        size = (image.shape[1], image.shape[0])
        return np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR), np.uint8)


class ReportingCamera:
    """A MAVLink camera component that reports its zoom level at 10 Hz."""

    def __init__(self, endpoint: str) -> None:
        self._link = mavutil.mavlink_connection(
            endpoint, source_system=VEHICLE, source_component=_CAMERA, dialect="ardupilotmega"
        )
        disable_reconnect(self._link)
        self._zooming = Zooming(1.0, 1.0, 0, 0)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera component", daemon=True)

    def set(self, zooming: Zooming) -> None:
        """Set the change of the focal length to report."""
        self._zooming = zooming

    def __enter__(self) -> ReportingCamera:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._link.close()

    def _run(self) -> None:
        started_ns = time.monotonic_ns()
        while not self._over.wait(_PERIOD_S):
            now_ns = time.monotonic_ns()
            boot_ms = (now_ns - started_ns) // 1_000_000
            try:
                self._link.mav.camera_settings_send(
                    boot_ms, mavlink.CAMERA_MODE_VIDEO, level_of(self._zooming.at(now_ns)), 0.0
                )
                while self._link.recv_msg() is not None:  # nobody reads it, and it must not wait
                    pass
            except OSError:  # the vehicle has ended
                return
