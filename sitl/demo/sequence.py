"""Writes evaluation sequences without a flight: ``images/``, ``poses.txt``, ``camera.json``."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from localizer.geometry.camera import Camera
from localizer.geometry.geo import LocalFrame
from localizer.geometry.posefile import PoseRow, pose_row, write_poses
from localizer.pictures import write_rgb
from sitl.camera.true_motion import PoseTrack
from sitl.camera.world_camera import WorldCamera

_JPEG_QUALITY = 92


def record_sequence(
    camera: WorldCamera,
    track: PoseTrack,
    times_ns: Iterable[int],
    frame: LocalFrame,
    out: Path,
    calibrated: Camera | None = None,
    stamped: Callable[[int], int] = lambda time_ns: time_ns,
) -> int:
    """Render frames at the given times and write them with their true poses; returns their number.

    Times outside the track are left out. calibrated: camera model to write, if it differs from the
    true one. frame: ENU frame of the track. stamped: gives the timestamp of a true time, which is
    written to ``images/timestamps.txt``.
    """
    images = out / "images"
    images.mkdir(parents=True, exist_ok=True)
    rows: list[PoseRow] = []
    stamps: list[str] = []
    for time_ns in times_ns:
        exposure = camera.expose(time_ns, track)
        if exposure is None:
            continue
        name = f"{len(rows):06d}.jpg"
        write_rgb(images / name, exposure.image, _JPEG_QUALITY)
        rows.append(pose_row(name, exposure.world_from_camera, frame))
        stamps.append(f"{name} {stamped(time_ns)}\n")
    write_poses(out / "poses.txt", rows)
    (images / "timestamps.txt").write_text("".join(stamps), encoding="utf-8")
    told = (calibrated or camera.camera).to_dict()
    (out / "camera.json").write_text(json.dumps(told, indent=2) + "\n")
    return len(rows)
