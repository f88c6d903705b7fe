"""`RecordedFlight`, the common form of recorded flights.

Angles are those of a gimbal relative to north and the horizon: Rz(yaw) Ry(pitch) Rx(roll) from NED,
pitch -90 looks down, yaw clockwise from true north. `None` means not recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Literal

import numpy as np

from companion.geometry import GIMBAL_FROM_CAMERA
from companion.sources.base import fitted_camera
from companion.sources.folder_source import read_image
from companion.sources.zoom import with_focal_factor
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, matrix_from_euler, so3_exp, so3_log
from localizer.types import Frame

Kind = Literal["photos", "video", "sequence"]
TILT_DEG, HEADING_DEG = 2.0, 6.0  # sigmas of a gimbal that is not calibrated, and of its compass
ABSOLUTE_M = 30.0  # of a drone's altitude without RTK: barometer and model of the atmosphere
_BAROMETER_M, _BAROMETER_SHARE = 2.0, 0.02


class Datum(Enum):
    """Reference surface of a height."""

    ELLIPSOID = "WGS84 ellipsoid"
    AMSL = "mean sea level"
    TAKEOFF = "take-off point"


@dataclass(frozen=True)
class Height:
    """A recorded height and its standard deviation, metres."""

    value_m: float
    datum: Datum
    sigma_m: float

    @classmethod
    def by_barometer(cls, value_m: float) -> Height:
        """A height above the take-off point by a drone's barometer."""
        sigma = math.hypot(_BAROMETER_M, _BAROMETER_SHARE * value_m)
        return cls(value_m, Datum.TAKEOFF, sigma)


@dataclass(frozen=True)
class RecordedPosition:
    """Camera position, WGS84 degrees. sigma_m: per horizontal axis. heights: all that were
    recorded; the map decides which one is used.
    """

    latitude_deg: float
    longitude_deg: float
    sigma_m: float
    heights: tuple[Height, ...] = ()

    def height_m(self, datum: Datum) -> float | None:
        """The recorded height above that surface; None without one."""
        return next((h.value_m for h in self.heights if h.datum is datum), None)


@dataclass(frozen=True, eq=False)
class RecordedView:
    """Camera direction. ned_from_camera: (3, 3), OpenCV axes; heading_sigma_deg: None if the
    heading is unknown (taken as 0). measured: whether roll and pitch were measured; otherwise they
    are assumed.
    """

    ned_from_camera: Array
    tilt_sigma_deg: float
    heading_sigma_deg: float | None
    measured: bool = True

    @classmethod
    def of_angles(
        cls,
        roll_deg: float,
        pitch_deg: float,
        yaw_deg: float,
        tilt_sigma_deg: float = TILT_DEG,
        heading_sigma_deg: float | None = HEADING_DEG,
        *,
        measured: bool = True,
    ) -> RecordedView:
        """From a gimbal's angles relative to north and the horizon, as Rz(yaw) Ry(pitch) Rx(roll);
        pitch -90 looks down.
        """
        angles = (float(a) for a in np.radians([roll_deg, pitch_deg, yaw_deg]))
        attitude = np.asarray(matrix_from_euler(*angles) @ GIMBAL_FROM_CAMERA)
        return cls(attitude, tilt_sigma_deg, heading_sigma_deg, measured)

    @property
    def nadir_angle_deg(self) -> float:
        """Angle between the optical axis and straight down."""
        return float(np.degrees(np.arccos(np.clip(self.ned_from_camera[2, 2], -1.0, 1.0))))


@dataclass(frozen=True)
class Telemetry:
    """Telemetry of one time. time_ns: on the clock of its source, None if not dated.

    course_deg: direction of flight or of the aircraft's nose, from true north; zoom: multiple of
    the camera's focal length.
    """

    time_ns: int | None = None
    position: RecordedPosition | None = None
    view: RecordedView | None = None
    course_deg: float | None = None
    zoom: float = 1.0


@dataclass(frozen=True)
class RecordedFrame:
    """One image file with its telemetry. time_ns: exposure, on the footage's clock; frames without
    a time are ordered by name.
    """

    name: str
    path: Path
    time_ns: int | None
    telemetry: Telemetry = Telemetry()

    def with_telemetry(self, telemetry: Telemetry) -> RecordedFrame:
        """The same image with other telemetry."""
        return replace(self, telemetry=telemetry)

    def load(self, camera: Camera, time_ns: int, sequence: int = 0) -> Frame:
        """Load the image as a `Frame` with the camera at its size and zoom. StreamDecodeError or
        StreamSizeError for an unusable image.
        """
        image = read_image(self.path)
        camera = fitted_camera(image.shape[1], image.shape[0], camera, self.name)
        return Frame(image, time_ns, with_focal_factor(camera, self.telemetry.zoom), sequence)


@dataclass(frozen=True)
class CameraGuess:
    """A camera model and the sigma of its focal length in per cent. source: origin of the model."""

    camera: Camera
    focal_percent: float
    source: str


@dataclass(frozen=True)
class LogBeside:
    """The autopilot's log of the flight. ahead_ns: its clock minus that of the images;
    fixed_pitch_deg: of a camera on the airframe, None if the log has gimbal angles.
    """

    path: Path
    ahead_ns: int
    fixed_pitch_deg: float | None


@dataclass(frozen=True)
class RecordedFlight:
    """Frames in time order, with telemetry and camera. kind: independent photos, or a sequence of
    overlapping frames; notes: assumptions and omissions; log: source of the telemetry, if a log.
    """

    name: str
    kind: Kind
    frames: tuple[RecordedFrame, ...]
    camera: CameraGuess
    notes: tuple[str, ...] = ()
    log: LogBeside | None = None

    @property
    def located_count(self) -> int:
        """Number of frames with a recorded position."""
        return sum(frame.telemetry.position is not None for frame in self.frames)


class Track:
    """Telemetry over time with interpolation; None in gaps above `gap_s`. times_ns: ascending times
    of the samples, int64.
    """

    def __init__(self, samples: Sequence[Telemetry], gap_s: float = 2.5) -> None:
        dated = sorted((s.time_ns, k) for k, s in enumerate(samples) if s.time_ns is not None)
        self._samples = tuple(samples[k] for _, k in dated)
        self.times_ns = np.array([t for t, _ in dated], dtype=np.int64)
        self._gap_ns = round(1e9 * gap_s)

    def __len__(self) -> int:
        return len(self._samples)

    def at(self, time_ns: int) -> Telemetry | None:
        """Telemetry at a time (ns), interpolated; None in gaps and outside the samples, except
        within a tenth of `gap_s`, where the nearest one is returned.
        """
        if not len(self.times_ns):
            return None
        after = int(np.searchsorted(self.times_ns, time_ns))
        if after < len(self.times_ns) and self.times_ns[after] == time_ns:
            return self._samples[after]
        if after in (0, len(self.times_ns)):
            near = 0 if after == 0 else after - 1
            away_ns = abs(int(self.times_ns[near]) - time_ns)
            return self._samples[near] if away_ns < self._gap_ns // 10 else None
        begin, end = int(self.times_ns[after - 1]), int(self.times_ns[after])
        if end - begin > self._gap_ns:
            return None
        return _between(
            self._samples[after - 1],
            self._samples[after],
            time_ns,
            (time_ns - begin) / (end - begin),
        )


def _between(a: Telemetry, b: Telemetry, time_ns: int, share: float) -> Telemetry:
    nearer = a if share < 0.5 else b
    position, view = nearer.position, nearer.view
    if a.position is not None and b.position is not None:
        position = _position_between(a.position, b.position, share)
    if a.view is not None and b.view is not None:
        first, last = a.view.ned_from_camera, b.view.ned_from_camera
        turn = so3_exp(share * so3_log(last @ first.T))
        view = replace(nearer.view or a.view, ned_from_camera=turn @ first)
    course = nearer.course_deg
    if a.course_deg is not None and b.course_deg is not None:
        course = _angle_between(a.course_deg, b.course_deg, share)
    return Telemetry(time_ns, position, view, course, nearer.zoom)


def _position_between(a: RecordedPosition, b: RecordedPosition, share: float) -> RecordedPosition:
    heights = tuple(
        replace(low, value_m=low.value_m + share * (high.value_m - low.value_m))
        for low in a.heights
        for high in b.heights
        if low.datum is high.datum
    )
    turn = (b.longitude_deg - a.longitude_deg + 180.0) % 360.0 - 180.0  # across the antimeridian
    return RecordedPosition(
        a.latitude_deg + share * (b.latitude_deg - a.latitude_deg),
        a.longitude_deg + share * turn,
        max(a.sigma_m, b.sigma_m),
        heights,
    )


def _angle_between(a: float, b: float, share: float) -> float:
    return a + share * ((b - a + 180.0) % 360.0 - 180.0)
