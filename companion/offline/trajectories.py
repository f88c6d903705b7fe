"""The files of a localized trajectory: pose lines, TUM, covariances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from localizer.geometry.geo import LocalFrame
from localizer.geometry.posefile import pose_row, write_poses
from localizer.geometry.trajectory import StampedPose, write_covariances, write_tum
from localizer.types import PoseEstimate


def stamped(name: str, estimate: PoseEstimate) -> StampedPose:
    """An estimate as a trajectory's pose."""
    return StampedPose(
        name, estimate.world_from_camera, estimate.exposure_time_ns, estimate.covariance
    )


def write_trajectory(folder: Path, poses: Sequence[StampedPose], frame: LocalFrame) -> None:
    """``poses.txt`` (our pose lines), ``trajectory.tum`` and ``covariances.csv``, in one order."""
    write_poses(folder / "poses.txt", (pose_row(p.name, p.world_from_camera, frame) for p in poses))
    write_tum(folder / "trajectory.tum", poses)
    write_covariances(folder / "covariances.csv", poses)
