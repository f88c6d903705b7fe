"""Trajectories: camera poses with names, times and covariances, and their files.

TUM's format (``time x y z qx qy qz qw``, seconds and metres) is read by evo and most tools. Its
poses here are `world_from_camera` in the map's ENU frame, OpenCV camera axes.

PiLoT's pose lines are ``name lon lat alt roll pitch yaw`` (degrees, ellipsoidal metres). Pitch 0
looks at the nadir, yaw counts counter-clockwise from north. The rotation is ``R = Rz(yaw) Ry(roll)
Rx(pitch)`` from the OpenGL camera to ENU *at the camera's own position*; flipping y and z turns the
camera axes into OpenCV's.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from localizer.errors import GeoreferenceError, PoseFileError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import (
    Array,
    Pose,
    euler_from_matrix,
    matrix_from_euler,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from localizer.plain_files import plain_text

_OPENCV_FROM_OPENGL: Array = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PoseRow:
    """One line of a pose file. Angles in degrees."""

    name: str
    position: Geodetic
    roll_deg: float
    pitch_deg: float
    yaw_deg: float


def read_poses(path: Path | str) -> tuple[PoseRow, ...]:
    """All poses of a file, in order. Blank lines and lines that begin with # are skipped.

    A line is ``name lon lat alt roll pitch yaw``: degrees, metres above the ellipsoid.
    `PoseFileError` if the file cannot be read, a line is malformed, a name is repeated, or there is
    no pose.
    """
    rows = [
        _parse(line, f"{path}:{number}")
        for number, line in enumerate(text_lines(Path(path)), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise PoseFileError(f"{path}: holds no pose; expected 'name lon lat alt roll pitch yaw'")
    name, count = Counter(row.name for row in rows).most_common(1)[0]
    if count > 1:
        raise PoseFileError(f"{path}: {count} lines are of {name}; leave the right one")
    return tuple(rows)


def text_lines(path: Path) -> list[str]:
    """The lines of a file of poses; `PoseFileError` if it cannot be read."""
    try:
        return plain_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PoseFileError(f"{path}: cannot be read: {error}") from error


def _parse(line: str, where: str) -> PoseRow:
    parts = line.split()
    if len(parts) != 7:
        raise PoseFileError(
            f"{where}: expected 'name lon lat alt roll pitch yaw', got {len(parts)} fields"
        )
    try:
        lon, lat, height, roll, pitch, yaw = (float(x) for x in parts[1:])
        row = PoseRow(parts[0], Geodetic(lat, lon, height), roll, pitch, yaw)
    except (ValueError, GeoreferenceError) as error:
        raise PoseFileError(f"{where}: {error}") from error
    if not np.isfinite([roll, pitch, yaw]).all():
        raise PoseFileError(f"{where}: angles must be finite")
    return row


def write_poses(path: Path | str, rows: Iterable[PoseRow]) -> None:
    """Write a pose file into an existing folder, replacing one there. Rounded to 1e-9 degrees of
    position (0.1 mm), 1e-4 m and 1e-6 degrees of angle. Names must be without blanks.
    """
    Path(path).write_text("".join(f"{pose_line(row)}\n" for row in rows), encoding="utf-8")


def pose_line(row: PoseRow) -> str:
    """The line of a pose file that `read_poses` reads, without its end."""
    p = row.position
    return (
        f"{row.name} {p.longitude_deg:.9f} {p.latitude_deg:.9f} {p.height_m:.4f} "
        f"{row.roll_deg:.6f} {row.pitch_deg:.6f} {row.yaw_deg:.6f}"
    )


def world_from_camera(row: PoseRow, frame: LocalFrame) -> Pose:
    """The row's pose, OpenCV camera axes to the ENU frame of the map about `frame`'s origin."""
    p = row.position
    centre = frame.enu_from_geodetic(p.latitude_deg, p.longitude_deg, p.height_m)
    roll, pitch, yaw = np.radians([row.roll_deg, row.pitch_deg, row.yaw_deg])
    enu_from_opengl = matrix_from_euler(pitch, roll, yaw)  # Rz(yaw) Ry(roll) Rx(pitch)
    return Pose(_map_from_local(p, frame) @ enu_from_opengl @ _OPENCV_FROM_OPENGL, centre)


def pose_row(name: str, pose: Pose, frame: LocalFrame) -> PoseRow:
    """The pose file row of a pose world_from_camera; inverse of `world_from_camera`."""
    position = frame.position(pose.translation)
    R = _map_from_local(position, frame).T @ pose.rotation @ _OPENCV_FROM_OPENGL
    pitch, roll, yaw = (float(angle) for angle in np.degrees(euler_from_matrix(R)))
    return PoseRow(name, position, roll, pitch, yaw)


def _map_from_local(position: Geodetic, frame: LocalFrame) -> Array:
    """Rotation (3, 3) from the tangent plane at `position` to the map's: 0.5 arcmin per km."""
    rotation: Array = frame.ecef_from_enu.rotation.T @ LocalFrame(position).ecef_from_enu.rotation
    return rotation


_TUM_FIELDS = "time x y z qx qy qz qw"
COVARIANCE_COLUMNS = (
    "name", "exposure_time_ns",
    *(f"c{row}{column}" for row in range(6) for column in range(row, 6)),
)  # fmt: skip


@dataclass(frozen=True)
class StampedPose:
    """A camera pose. time_ns: exposure time; None if only the order is known.

    covariance: (6, 6) as in `PosePrior`; None if unknown.
    """

    name: str
    world_from_camera: Pose
    time_ns: int | None = None
    covariance: Array | None = None


def write_tum(path: Path, poses: Iterable[StampedPose]) -> None:
    """Write TUM lines (ns of time, 0.1 µm of position, 1e-9 of the quaternion) into an existing
    folder. `PoseFileError` if a pose has no time, and nothing is written then; OSError if the file
    cannot be written.
    """
    try:
        lines = [f"{tum_line(pose)}\n" for pose in poses]
    except PoseFileError as error:
        raise PoseFileError(f"{path}: {error}") from error
    path.write_text("".join(lines), encoding="utf-8")


def tum_line(pose: StampedPose) -> str:
    """The line of a TUM file, without its end. `PoseFileError` if the pose has no time."""
    if pose.time_ns is None:
        raise PoseFileError(f"{pose.name} has no time; TUM's lines need one")
    w, x, y, z = quaternion_from_matrix(pose.world_from_camera.rotation)
    seconds, rest = divmod(pose.time_ns, 10**9)
    position = " ".join(f"{value:.7f}" for value in pose.world_from_camera.translation)
    return f"{seconds}.{rest:09d} {position} {x:.9f} {y:.9f} {z:.9f} {w:.9f}"


def read_tum(path: Path) -> tuple[StampedPose, ...]:
    """All poses of a TUM file, named by their time in ns, without covariance. Blank lines and lines
    that begin with # are skipped. `PoseFileError` if the file cannot be read, a line is malformed,
    or there is no pose.
    """
    poses = tuple(
        _parse_tum(line, f"{path}:{number}")
        for number, line in enumerate(text_lines(path), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    )
    if not poses:
        raise PoseFileError(f"{path}: holds no pose; expected '{_TUM_FIELDS}'")
    return poses


def _parse_tum(line: str, where: str) -> StampedPose:
    parts = line.replace(",", " ").split()
    if len(parts) != 8:
        raise PoseFileError(f"{where}: expected '{_TUM_FIELDS}', got {len(parts)} fields")
    try:
        # Decimal: seconds of an epoch with nine digits behind the point do not fit into a float.
        time_ns = int((Decimal(parts[0]) * 10**9).to_integral_value())
        x, y, z, qx, qy, qz, qw = (float(part) for part in parts[1:])
    except (ValueError, ArithmeticError, InvalidOperation) as error:
        raise PoseFileError(f"{where}: {error}") from error
    if abs(time_ns) >= 1 << 63:
        raise PoseFileError(f"{where}: {parts[0][:20]} is no time in seconds")
    position, q = np.array([x, y, z]), np.array([qw, qx, qy, qz])
    if not np.isfinite([*position, *q]).all() or abs(np.linalg.norm(q) - 1.0) > 0.01:
        raise PoseFileError(f"{where}: not a position and a unit quaternion")
    return StampedPose(str(time_ns), Pose(matrix_from_quaternion(q), position), time_ns)


def covariance_row(pose: StampedPose) -> tuple[str, ...] | None:
    """The texts of `COVARIANCE_COLUMNS`, "" for an unknown time; None without a covariance."""
    if pose.covariance is None:
        return None
    time_ns = "" if pose.time_ns is None else str(pose.time_ns)
    values = (f"{value:.6e}" for value in pose.covariance[np.triu_indices(6)])
    return (pose.name, time_ns, *values)
