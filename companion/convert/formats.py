"""Reads and writes camera poses: one reader and one writer for each format.

The common form is `StampedPose` in the map's ENU frame.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.convert.angles import (
    AutopilotAngles,
    autopilot_of_pose,
    pose_of_autopilot,
)
from companion.convert.photos import Heights, read_photos, write_sidecars
from companion.errors import ConfigError
from companion.geometry import GimbalFrame
from companion.trajectory import snapshot_name
from localizer.errors import GeoreferenceError, PoseFileError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Pose, matrix_from_quaternion, quaternion_from_matrix
from localizer.geometry.trajectory import (
    StampedPose,
    pose_row,
    read_poses,
    read_tum,
    text_lines,
    world_from_camera,
    write_poses,
    write_tum,
)

AUTOPILOT_COLUMNS = (
    "name", "time_ns", "latitude_deg", "longitude_deg", "height_m",
    "roll_deg", "pitch_deg", "yaw_deg",
    "gimbal_roll_deg", "gimbal_pitch_deg", "gimbal_yaw_deg", "gimbal_frame",
)  # fmt: skip
_COUNTED = re.compile(r"#\s*Number of images:\s*(\d+)")
_IMAGES_TXT = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


@dataclass(frozen=True)
class MapReference:
    """The map's frame and what else is known of heights. map_frame: None if not given; heights:
    datum of photo tags, None if unknown. tell: called with warnings about a source.
    """

    map_frame: LocalFrame | None
    heights: Heights | None = None
    tell: Callable[[str], None] = lambda _: None

    @property
    def frame(self) -> LocalFrame:
        """The ENU frame, for conversions between map metres and latitude and longitude.
        `ConfigError` if neither map nor origin was given.
        """
        if self.map_frame is None:
            raise ConfigError(
                "these formats need the map's frame: give --map or --origin LAT,LON,HEIGHT"
            )
        return self.map_frame


Reader = Callable[[Path, MapReference], tuple[StampedPose, ...]]
Writer = Callable[[Path, Sequence[StampedPose], MapReference], None]


def _read_poses(path: Path, place: MapReference) -> tuple[StampedPose, ...]:
    return tuple(
        StampedPose(row.name, world_from_camera(row, place.frame)) for row in read_poses(path)
    )


def _write_poses(path: Path, poses: Sequence[StampedPose], place: MapReference) -> None:
    for pose in poses:
        if not pose.name or pose.name.split() != [pose.name]:
            raise PoseFileError(f"{path}: a pose line cannot hold the name {pose.name!r}")
    write_poses(path, (pose_row(p.name, p.world_from_camera, place.frame) for p in poses))


def _read_colmap(path: Path, place: MapReference) -> tuple[StampedPose, ...]:
    """Poses (camera from world) of an ``images.txt``, which has two lines an image. The second
    line, of points, may be missing, as in files of known poses that are written by hand.
    """
    if path.suffix.lower() == ".bin":
        raise PoseFileError(
            f"{path}: a binary model; colmap model_converter --output_type TXT writes its text"
        )
    poses: list[StampedPose] = []
    counted, points_follow = None, False
    for number, line in enumerate(text_lines(path), start=1):
        if line.startswith("#"):
            counted = _COUNTED.match(line) or counted
        elif points_follow and _are_points(line):
            points_follow = False
        elif line.strip():
            poses.append(_parse_colmap(line, f"{path}:{number}"))
            points_follow = True
    if not poses:
        raise PoseFileError(f"{path}: holds no image; expected '{_IMAGES_TXT}'")
    if counted is not None and int(counted[1]) != len(poses):
        raise PoseFileError(f"{path}: says {counted[1]} images, holds {len(poses)}; write it again")
    return tuple(poses)


def _are_points(line: str) -> bool:
    """Whether the line is an image's second line: X Y POINT3D_ID, any number of times. The first
    line has ten fields.
    """
    try:
        numbers = [float(x) for x in line.split()]
    except ValueError:
        return False
    return len(numbers) % 3 == 0


def _parse_colmap(line: str, where: str) -> StampedPose:
    parts = line.split(maxsplit=9)
    try:
        if len(parts) != 10:
            raise ValueError(f"expected '{_IMAGES_TXT}', got {len(parts)} fields")
        q, t = np.array([float(x) for x in parts[1:5]]), np.array([float(x) for x in parts[5:8]])
        if not np.isfinite([*q, *t]).all() or abs(np.linalg.norm(q) - 1.0) > 0.01:
            raise ValueError("not a unit quaternion and a translation")
    except ValueError as error:
        raise PoseFileError(f"{where}: {error}") from error
    return StampedPose(parts[9].strip(), Pose(matrix_from_quaternion(q), t).inverse)


def _write_colmap(path: Path, poses: Sequence[StampedPose], place: MapReference) -> None:
    lines = [f"# {_IMAGES_TXT}\n# world: the map's ENU frame, metres; no points\n"]
    for number, pose in enumerate(poses, start=1):
        inverse = pose.world_from_camera.inverse
        q = " ".join(f"{x:.12f}" for x in quaternion_from_matrix(inverse.rotation))
        t = " ".join(f"{x:.9f}" for x in inverse.translation)
        lines.append(f"{number} {q} {t} 1 {pose.name}\n\n")
    path.write_text("".join(lines), encoding="utf-8")


def _read_autopilot(path: Path, place: MapReference) -> tuple[StampedPose, ...]:
    poses = []
    try:
        rows = list(csv.DictReader(text_lines(path)))
    except csv.Error as error:
        raise PoseFileError(f"{path}: not a table: {error}") from error
    for number, row in enumerate(rows, start=2):
        angles = _autopilot_row(row, f"{path}:{number}")
        pose = pose_of_autopilot(angles, place.frame)
        poses.append(StampedPose(angles.name, pose, angles.time_ns))
    if not poses:
        raise PoseFileError(f"{path}: holds no row; expected {','.join(AUTOPILOT_COLUMNS)}")
    return tuple(poses)


def _autopilot_row(row: dict[str, Any], where: str) -> AutopilotAngles:
    try:
        lat, lon, height, *angles = (float(row[name]) for name in AUTOPILOT_COLUMNS[2:11])
        if not np.isfinite(angles).all():
            raise ValueError("angles must be finite")
        roll, pitch, yaw, *gimbal = angles
        return AutopilotAngles(
            row["name"],
            int(row["time_ns"]) if row["time_ns"] else None,
            Geodetic(lat, lon, height),
            (roll, pitch, yaw),
            (gimbal[0], gimbal[1], gimbal[2]),
            GimbalFrame(row["gimbal_frame"]),
        )
    except (KeyError, TypeError, ValueError, GeoreferenceError) as error:
        raise PoseFileError(
            f"{where}: {type(error).__name__} {error}; expected {','.join(AUTOPILOT_COLUMNS)}, "
            "gimbal_frame heading, earth or body"
        ) from error


def _write_autopilot(path: Path, poses: Sequence[StampedPose], place: MapReference) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(AUTOPILOT_COLUMNS)
        for pose in poses:
            a = autopilot_of_pose(pose.name, pose.time_ns, pose.world_from_camera, place.frame)
            p, angles = a.position, (*a.body_deg, *a.gimbal_deg)
            writer.writerow([
                a.name, "" if a.time_ns is None else a.time_ns,
                f"{p.latitude_deg:.9f}", f"{p.longitude_deg:.9f}", f"{p.height_m:.4f}",
                *(f"{x:.7f}" for x in angles), a.gimbal_frame.value,
            ])  # fmt: skip


def _read_record(path: Path, place: MapReference) -> tuple[StampedPose, ...]:
    """The accepted estimates of a flight's record (its folder, or its ``estimates.csv``)."""
    from companion.offline.record import read_estimates

    file = path / "estimates.csv" if path.is_dir() else path
    poses = tuple(
        StampedPose(snapshot_name(e.exposure_time_ns), e.world_from_camera, e.exposure_time_ns)
        for e in read_estimates(file)
        if e.accepted
    )
    if not poses:
        raise PoseFileError(f"{file}: holds no accepted estimate; is the record whole?")
    return poses


READERS: dict[str, Reader] = {
    "poses": _read_poses,
    "tum": lambda path, _: read_tum(path),
    "colmap": _read_colmap,
    "photos": lambda path, place: read_photos(path, place.frame, place.heights, place.tell),
    "autopilot": _read_autopilot,
    "record": _read_record,
}
WRITERS: dict[str, Writer] = {
    "poses": _write_poses,
    "tum": lambda path, poses, _: write_tum(path, poses),
    "colmap": _write_colmap,
    "photos": lambda path, poses, place: write_sidecars(path, poses, place.frame, place.heights),
    "autopilot": _write_autopilot,
}
