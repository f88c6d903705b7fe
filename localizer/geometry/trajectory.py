"""Trajectories: camera poses with names, times and covariances, and their files.

TUM's format (``time x y z qx qy qz qw``, seconds and metres) is read by evo and most tools. Its
poses here are `world_from_camera` in the map's ENU frame, OpenCV camera axes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from localizer.errors import PoseFileError
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion, quaternion_from_matrix
from localizer.geometry.posefile import text_lines

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
