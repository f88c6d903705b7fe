"""An MCAP file (https://mcap.dev) with Foxglove's schemas: written row by row.

Topics: /vision/pose, /vision/location, /tf, /camera/image, /camera/calibration, /targets,
/targets/map, /autopilot/location, /gnss/location, /events, /mavlink/text, /diagnostics.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from companion.export import messages
from companion.export.messages import Row
from companion.versions import versions
from localizer.geometry.camera import Camera
from localizer.plain_files import plain_bytes

_CHUNK = 256 << 10  # what a loss of power costs at most, before compression
_PROFILE = ""  # Foxglove's schemas need none


class McapFile:
    """Writes rows of a flight to an MCAP file, which is replaced. clock_offset_ns: from
    CLOCK_MONOTONIC to UTC; camera: of the images, None: no calibration.
    """

    def __init__(self, path: Path, clock_offset_ns: int, camera: Camera | None) -> None:
        self._offset_ns, self._camera = clock_offset_ns, camera
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        name = f"pilot-companion {versions().get('pilot-companion', '')}".strip()
        self._writer.start(_PROFILE, name)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.messages = 0
        """How many were written, of all topics; a row can be several."""

    def estimate(self, row: Row) -> None:
        """Write a row of ``estimates.csv``: diagnostics and, if accepted, the pose."""
        time_ns = self._utc_ns(row["exposure_time_ns"])
        self._put_json("/diagnostics", messages.diagnostics(row, time_ns), time_ns)
        if messages.is_accepted(row):
            self.put("/tf", messages.transform(row, time_ns), time_ns)
            self.put("/vision/pose", messages.pose(row, time_ns), time_ns)
            self.put("/vision/location", messages.location(row, time_ns), time_ns)

    def target(self, row: Row) -> None:
        """Write a row of ``targets.csv``."""
        time_ns = self._utc_ns(row["exposure_time_ns"])
        self.put("/targets", messages.target(row, time_ns), time_ns)
        self.put("/targets/map", messages.target_on_map(row), time_ns)

    def event(self, row: Row) -> None:
        """Write a row of ``events.csv``."""
        time_ns = self._utc_ns(row["time_ns"])
        self.put("/events", messages.event(row, time_ns), time_ns)

    def image(self, jpeg: bytes, exposure_time_ns: int) -> None:
        """Write a recorded image with its calibration."""
        time_ns = self._utc_ns(exposure_time_ns)
        if self._camera is not None:
            calibration = messages.calibration(self._camera, time_ns)
            self.put("/camera/calibration", calibration, time_ns)
        self.put("/camera/image", messages.image(jpeg, time_ns), time_ns)

    def put(self, topic: str, message: Any, time_ns: int) -> None:
        """Write a message of Foxglove's schemas. time_ns: UTC."""
        kind = type(message)
        name = kind.DESCRIPTOR.full_name
        if name not in self._schemas:
            self._schemas[name] = register_schema(self._writer, kind)
        self._add(topic, "protobuf", self._schemas[name], message.SerializeToString(), time_ns)

    def attach(self, path: Path) -> None:
        """Attach a JSON file of the record unchanged."""
        time_ns = path.stat().st_mtime_ns
        self._writer.add_attachment(
            time_ns, time_ns, path.name, "application/json", plain_bytes(path)
        )

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()

    def _utc_ns(self, time_ns: Any) -> int:
        return max(int(time_ns) + self._offset_ns, 0)

    def _put_json(self, topic: str, value: dict[str, Any], time_ns: int) -> None:
        name = messages.DIAGNOSTICS_NAME
        if name not in self._schemas:
            text = json.dumps(messages.DIAGNOSTICS_SCHEMA).encode()
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", text)
        self._add(topic, "json", self._schemas[name], json.dumps(value).encode(), time_ns)

    def _add(self, topic: str, encoding: str, schema: int, data: bytes, time_ns: int) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema)
        self._writer.add_message(self._channels[topic], time_ns, data, time_ns)
        self.messages += 1
