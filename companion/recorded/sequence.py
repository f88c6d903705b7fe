"""Sequences with true poses: ours (``images/``, ``poses.txt``, ``camera.json``) and PiLoT's data
set (``images/NAME/``, ``poses/NAME.txt``, with ``camera.json`` or ``cameras/NAME.json``).
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from companion.recorded.cameras import camera_given
from companion.recorded.flight import (
    HEADING_DEG,
    TILT_DEG,
    Datum,
    Height,
    RecordedFlight,
    RecordedFrame,
    RecordedPosition,
    RecordedView,
    Telemetry,
)
from companion.sources.folder_source import TIMESTAMPS_NAME, exposure_times_of
from localizer.errors import SequenceError
from localizer.evaluation.sequences import Sequence
from localizer.geometry.camera import Camera
from localizer.geometry.geo import NED_FROM_ENU, Geodetic, LocalFrame
from localizer.geometry.pose import Pose
from localizer.geometry.trajectory import PoseRow, read_poses, world_from_camera
from localizer.plain_files import files_of

# Video that says nothing of time is taken as 30 frames per second (the paper's data sets).
_FRAME_INTERVAL_NS = 33_333_333
_PLACE_M, _HEIGHT_M = 5.0, 5.0  # where a pose is only a prior


def is_sequence(folder: Path) -> bool:
    """Whether the folder has one of the two layouts."""
    return (folder / "images").is_dir() and (
        (folder / "poses.txt").is_file() or (folder / "poses").is_dir()
    )


def read_sequence(folder: Path, name: str | None = None) -> RecordedFlight:
    """Read a sequence of either layout; `name` selects one of PiLoT's. `SequenceError` if the
    folder or an image is missing, or exposure times do not increase; `PoseFileError`,
    `CameraError`, `StreamDecodeError` for the files of poses, camera and times.
    """
    if not folder.is_dir():
        raise SequenceError(f"{folder}: no such folder")
    images, poses, camera = _layout(folder, name)
    rows = read_poses(poses)
    missing = [row.name for row in rows if not (images / row.name).is_file()]
    if missing:
        raise SequenceError(
            f"{images}: {len(missing)} of {len(rows)} images named in {poses.name} are missing, "
            f"first {missing[0]}"
        )
    times = exposure_times_of(images, [images / row.name for row in rows])
    if times is not None and any(b <= a for a, b in itertools.pairwise(times)):
        raise SequenceError(f"{images / TIMESTAMPS_NAME}: exposure times must increase")
    frames = tuple(
        RecordedFrame(row.name, images / row.name, time_ns, _telemetry(row, time_ns))
        for row, time_ns in zip(rows, times or [None] * len(rows), strict=True)
    )
    guess = camera_given(Camera.from_json(camera), camera.name)
    return RecordedFlight(folder.name, "sequence", frames, guess)


def sequence_of(flight: RecordedFlight, frame: LocalFrame, geoid_m: float) -> Sequence:
    """As a `Sequence` with the recorded poses as truth in this map frame; `SequenceError` if one is
    missing. geoid_m: geoid above the ellipsoid, for heights above sea level. Without increasing
    times, frames are taken as 1/30 s apart.
    """
    truth = [_pose(one.telemetry, frame, geoid_m) for one in flight.frames]
    whole = tuple(pose for pose in truth if pose is not None)
    if len(whole) < len(truth) or not whole:
        raise SequenceError(
            f"{flight.name}: {len(truth) - len(whole)} of {len(truth)} frames have no true pose: "
            "position, height above the ellipsoid or mean sea level, and measured view; give a "
            "pose file (poses.txt)"
        )
    times = tuple(one.time_ns for one in flight.frames if one.time_ns is not None)
    is_timed = len(times) == len(truth) and all(a < b for a, b in itertools.pairwise(times))
    assumed = tuple((index + 1) * _FRAME_INTERVAL_NS for index in range(len(truth)))
    paths = tuple(one.path for one in flight.frames)
    return Sequence(paths, times if is_timed else assumed, whole, flight.camera.camera, is_timed)


def load_sequence(folder: Path, frame: LocalFrame) -> Sequence:
    """Read a sequence folder (`read_sequence`) as a `Sequence` in a map's frame."""
    return sequence_of(read_sequence(folder), frame, 0.0)


def _telemetry(row: PoseRow, time_ns: int | None) -> Telemetry:
    here = row.position
    attitude = NED_FROM_ENU @ world_from_camera(row, LocalFrame(here)).rotation
    height = Height(here.height_m, Datum.ELLIPSOID, _HEIGHT_M)
    place = RecordedPosition(here.latitude_deg, here.longitude_deg, _PLACE_M, (height,))
    return Telemetry(time_ns, place, RecordedView(attitude, TILT_DEG, HEADING_DEG))


def _pose(said: Telemetry, frame: LocalFrame, geoid_m: float) -> Pose | None:
    if said.position is None or said.view is None or not said.view.measured:
        return None
    height, amsl = (said.position.height_m(datum) for datum in (Datum.ELLIPSOID, Datum.AMSL))
    if height is None and amsl is not None:
        height = amsl + geoid_m
    if height is None:
        return None
    p = Geodetic(said.position.latitude_deg, said.position.longitude_deg, height)
    centre = np.asarray(frame.enu_from_geodetic(p.latitude_deg, p.longitude_deg, p.height_m))
    return Pose(frame.ned_from_enu(p).T @ said.view.ned_from_camera, centre)


def _layout(path: Path, name: str | None) -> tuple[Path, Path, Path]:
    """(image folder, pose file, camera file) of a sequence folder."""
    if (path / "poses.txt").is_file():
        return path / "images", path / "poses.txt", path / "camera.json"
    poses = path / "poses"
    names = [p.stem for p in files_of(poses, (".txt",))] if poses.is_dir() else []
    if not names:
        raise SequenceError(f"{path}: holds neither poses.txt nor poses/NAME.txt")
    if name is None and len(names) > 1:
        raise SequenceError(f"{path}: holds {len(names)} sequences, name one: {', '.join(names)}")
    chosen = name or names[0]
    if chosen not in names:
        raise SequenceError(f"{path}: no sequence {chosen!r}, there are: {', '.join(names)}")
    own = path / "cameras" / f"{chosen}.json"
    camera = own if own.is_file() else path / "camera.json"
    return path / "images" / chosen, path / "poses" / f"{chosen}.txt", camera
