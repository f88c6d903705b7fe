"""The frames that a record kept, with views of the map from their poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from companion.console.record_rows import ABSURD, estimate_of, last_row
from companion.errors import StreamDecodeError
from companion.live.protocol import Message
from companion.live.shown import pose_data
from companion.offline.record import RecordTables, is_time_ns
from companion.offline.tables import Columns, poses
from companion.reporting.pictures import MapPictures
from companion.sources.folder_source import read_image
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose


class KeptPictures:
    """Returns each recorded frame once, at its time, with the map's view. pictures: renderer of the
    map, None: without map view.
    """

    def __init__(self, tables: RecordTables, pictures: MapPictures | None) -> None:
        self._tables, self._map = tables, pictures
        paths = (tables.folder / "snapshots").glob("*.jpg")
        self._kept = sorted((int(p.stem), p) for p in paths if is_time_ns(p.stem))
        self._shown: int | None = None

    def newest(self, now_ns: int) -> Message | None:
        """The newest frame up to a time, with the estimate of its exposure; None if there is none,
        it was returned by the call before, or it cannot be used. Renders, which takes a while.
        """
        camera = self._tables.camera
        known = [p for p in self._kept if p[0] <= now_ns]
        if not known or camera is None or known[-1][0] == self._shown:
            return None
        self._shown, path = known[-1]
        return self._picture(path, camera)

    def _picture(self, path: Path, camera: Camera) -> Message | None:
        time_ns = int(path.stem)
        try:
            rgb = read_image(path)
        except (StreamDecodeError, OSError):  # power may have gone while it was written
            return None
        if rgb.shape[:2] != (camera.height, camera.width):
            return None
        head: dict[str, Any] = {
            "kind": "frame", "exposure_ns": time_ns, "recorded": True, "camera": camera.to_dict(),
            "image": [camera.width, camera.height], "estimate": None, "view": None,
        }  # fmt: skip
        parts = [rgb.tobytes()]
        row = last_row(self._tables.estimates, "exposure_time_ns", time_ns)
        if row is not None and self._tables.estimates["exposure_time_ns"][row] == time_ns:
            pose = _pose_of(self._tables.estimates, row)
            if pose is not None:
                estimate = estimate_of(self._tables.estimates, row)
                head["estimate"] = estimate | {"pose": pose_data(pose)}
                parts += self._seen_from(pose, camera, head) if estimate["accepted"] else []
        return Message(head, b"".join(parts))

    def _seen_from(self, pose: Pose, camera: Camera, head: dict[str, Any]) -> list[bytes]:
        """The map's colours and depth at that pose; [] without the map."""
        if self._map is None or self._map.renderer is None:
            return []
        target = camera.without_distortion()
        view = self._map.renderer.render(pose, target, wait=True)
        head["view"] = {"camera": target.to_dict(), "pose": pose_data(pose)}
        return [view.rgb.tobytes(), view.depth.tobytes()]


def _pose_of(columns: Columns, row: int) -> Pose | None:
    """Pose world_from_camera of a row; None if a number is missing."""
    names = ("east_m", "north_m", "up_m", "qw", "qx", "qy", "qz")
    values = {name: np.asarray(columns[name][row : row + 1]) for name in names if name in columns}
    if len(values) < len(names) or not all(abs(v[0]) < ABSURD for v in values.values()):
        return None
    if sum(float(values[f"q{x}"][0]) ** 2 for x in "wxyz") < 0.5:
        return None  # no rotation
    return poses(values)[0]
