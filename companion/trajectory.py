"""Trajectory files: pose lines, TUM, covariances, written at once or during the flight."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Iterable
from pathlib import Path

from localizer.geometry.geo import LocalFrame
from localizer.geometry.trajectory import (
    COVARIANCE_COLUMNS,
    StampedPose,
    covariance_row,
    pose_line,
    pose_row,
    tum_line,
)
from localizer.types import PoseEstimate

TRAJECTORY_NAMES = ("poses.txt", "trajectory.tum", "covariances.csv")


def to_stamped_pose(name: str, estimate: PoseEstimate) -> StampedPose:
    """An estimate as a `StampedPose` with its exposure time."""
    return StampedPose(
        name, estimate.world_from_camera, estimate.exposure_time_ns, estimate.covariance
    )


def snapshot_name(exposure_time_ns: int) -> str:
    """File name of the frame with that exposure time, in snapshots and trajectory."""
    return f"{exposure_time_ns}.jpg"


class TrajectoryFiles:
    """Writes ``poses.txt`` (our pose lines), ``trajectory.tum`` and ``covariances.csv``.

    folder: exists; files of these names are replaced. frame: of the poses, for the geodetic pose
    lines. OSError if the disk does not accept them.
    """

    def __init__(self, folder: Path, frame: LocalFrame) -> None:
        self._frame = frame
        with contextlib.ExitStack() as stack:
            self._poses, self._tum, self._covariances = (
                stack.enter_context((folder / name).open("w", newline="", encoding="utf-8"))
                for name in TRAJECTORY_NAMES
            )
            self._rows = csv.writer(self._covariances)
            self._rows.writerow(COVARIANCE_COLUMNS)
            self._stack = stack.pop_all()

    def append(self, pose: StampedPose) -> None:
        """Append a pose. `PoseFileError`, and nothing is written, without a time, which TUM needs.
        A pose without a covariance has no row in covariances.csv.
        """
        # All three lines are made before the first is written: the files stay in one order.
        line, tum = (
            pose_line(pose_row(pose.name, pose.world_from_camera, self._frame)),
            tum_line(pose),
        )
        row = covariance_row(pose)
        self._poses.write(line + "\n")
        self._tum.write(tum + "\n")
        if row is not None:
            self._rows.writerow(row)

    def flush(self) -> None:
        """Write the buffers to the disk."""
        for file in (self._poses, self._tum, self._covariances):
            file.flush()

    def close(self) -> None:
        """Close the files."""
        self._stack.close()


def write_trajectory(folder: Path, poses: Iterable[StampedPose], frame: LocalFrame) -> None:
    """Write the files of a complete trajectory, as `TrajectoryFiles`, and close them."""
    files = TrajectoryFiles(folder, frame)
    with contextlib.closing(files):
        for pose in poses:
            files.append(pose)
