"""``companion klv``: adds the metadata of a flight's record to a recording of its video."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from companion.errors import RecordError, StreamOpenError
from companion.klv.local_set import encode
from companion.klv.metadata import KlvContext, frame_fields
from companion.klv.transport import TransportWriter
from companion.offline.record import Columns, RecordTables, poses, read_record
from companion.reporting.figures import nearest
from companion.sources.base import fitted_camera, has_times, video_stream
from companion.sources.timing import misp_time
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Array, matrix_from_euler
from localizer.map.cache.cache import TileCache
from localizer.map.cache.pick import MapSurface
from localizer.types import PoseEstimate, RegistrationStatus, TargetFix, TrackingState
from mavlink_bridge.link.tlog import read_tlog

_SAME_NS = 5_000_000  # a picture and its estimate
_ATTITUDE_NS = 100_000_000
_TARGET_NS = 1_000_000_000


@dataclass(frozen=True)
class Written:
    """Result. pictures: number of the video's frames; described: of frames with metadata."""

    path: Path
    pictures: int
    described: int


def describe_recording(
    video: Path,
    record: Path,
    out: Path,
    *,
    map_cache: Path | None = None,
    begin_s: float | None = None,
    mission: str = "",
    progress: Callable[[], None] = lambda: None,
) -> Written:
    """Write `video` as MPEG-TS with ST 0601 metadata for each localized frame.

    begin_s: exposure of its first frame, seconds since the record's start; None if the frames have
    MISP timestamps. `RecordError`, also if no frame was localized (then `out` is removed), and
    `StreamError`; OSError if `out` cannot be written.
    """
    tables = read_record(record)
    map_path = map_cache or tables.map_path
    if map_path is None:
        raise RecordError(f"{record}: does not say which map was flown on; give it as --map")
    if tables.camera is None or not tables.estimates:
        raise RecordError(f"{record}: holds no estimate, or does not say which camera")
    if not tables.utc_ns:
        raise RecordError(f"{record}: does not say what time it was (record.json)")
    cache = TileCache.open(map_path)
    tables.flown_map.require_frame(cache)
    with ExitStack() as stack:
        scene = KlvContext(
            cache.frame, MapSurface(cache).cast, cache.manifest.geoid_separation_m, mission
        )
        track = _RecordTrack(tables, scene)
        try:
            source = stack.enter_context(av.open(str(video)))
            stream = video_stream(source, str(video))
        except av.error.FFmpegError as error:
            raise StreamOpenError(f"{video}: not a video: {error}") from error
        if not has_times(source):
            raise StreamOpenError(
                f"{video}: raw video without times; put it into a container at its frame rate: "
                "ffmpeg -r RATE -i FILE -c copy FILE.mp4"
            )
        camera = fitted_camera(stream.width, stream.height, tables.camera, str(video))
        begin_ns = None if begin_s is None else tables.start_ns + round(begin_s * 1e9)
        clock = _Clock(begin_ns, tables.utc_ns - tables.start_ns)
        writer = TransportWriter(str(out), stream)
        pictures = described = 0
        try:
            for packet, taken in _packets(source, stream, clock):
                for pts, time_ns in taken:
                    pictures += 1
                    progress()
                    metadata = track.at(time_ns, camera)
                    if metadata is not None:
                        writer.describe(pts, metadata)
                        described += 1
                if packet.dts is not None:
                    writer.write(packet)
        finally:
            writer.close()
    if not described:
        out.unlink(missing_ok=True)
        raise RecordError(
            f"{video}: no frame of it was localized in {record}; are they of one flight? Say "
            "when its first frame was taken with --begin"
        )
    return Written(out, pictures, described)


@dataclass
class _Clock:
    """Gives the exposure of a frame on the record's CLOCK_MONOTONIC."""

    begin_ns: int | None
    utc_minus_monotonic_ns: int
    first: Fraction | None = None

    def exposure_ns(self, picture: av.VideoFrame) -> int | None:
        """Exposure of a frame, CLOCK_MONOTONIC; None if the frame does not state it."""
        pts = Fraction(picture.pts * picture.time_base)
        self.first = pts if self.first is None else self.first
        if self.begin_ns is not None:
            return self.begin_ns + round((pts - self.first) * 10**9)
        stamp = misp_time(picture)
        return None if stamp is None else stamp.time_us * 1000 - self.utc_minus_monotonic_ns


def _packets(
    source: av.container.InputContainer, stream: av.VideoStream, clock: _Clock
) -> Iterator[tuple[av.Packet, list[tuple[Fraction, int]]]]:
    """Yield every packet and (presentation time, exposure) of the frames decoded from it."""
    for packet in source.demux(stream):
        taken = []
        try:
            pictures = packet.decode()
        except av.error.InvalidDataError:
            pictures = []
        for picture in pictures:
            if picture.pts is not None:
                time_ns = clock.exposure_ns(picture)
                if time_ns is not None:
                    taken.append((Fraction(picture.pts * picture.time_base), time_ns))
        yield packet, taken


class _RecordTrack:
    """Data of the record at a time: pose, the aircraft's attitude, the newest target."""

    def __init__(self, tables: RecordTables, scene: KlvContext) -> None:
        self._scene = scene
        self._utc_ns = tables.utc_ns - tables.start_ns
        estimates = tables.estimates
        used = np.asarray(estimates["accepted"]) > 0
        kept: Columns = {name: values[used] for name, values in estimates.items()}
        order = np.argsort(kept["exposure_time_ns"], kind="stable")
        kept = {name: values[order] for name, values in kept.items()}
        self._times = np.asarray(kept["exposure_time_ns"], dtype=np.int64)
        self._poses = poses(kept)
        self._targets = _targets(tables.targets)
        self._attitudes = _attitudes(tables.tlog, self._utc_ns)

    def at(self, time_ns: int, camera: Camera) -> bytes | None:
        """Metadata packet of a frame; None if the frame was not localized."""
        (k,) = nearest(self._times, np.array([time_ns]), _SAME_NS)
        if k < 0:
            return None
        estimate = PoseEstimate(
            self._poses[k], np.zeros((6, 6)), 1.0, TrackingState.TRACKING, RegistrationStatus.OK,
            True, int(self._times[k]), 0, camera,
        )  # fmt: skip
        times, angles = self._attitudes
        (j,) = nearest(times, np.array([time_ns]), _ATTITUDE_NS)
        body = None if j < 0 else matrix_from_euler(*angles[j])
        fields = frame_fields(estimate, self._scene, body, self._target(time_ns))
        return encode((time_ns + self._utc_ns) // 1000, fields)

    def _target(self, time_ns: int) -> TargetFix | None:
        times, fixes = self._targets
        k = int(np.searchsorted(times, time_ns, side="right")) - 1
        if k < 0 or time_ns - times[k] > _TARGET_NS:
            return None
        return fixes[k]


def _targets(table: Columns) -> tuple[np.ndarray, list[TargetFix]]:
    """Times and fixes of all target reports, in the order of time."""
    rows = []
    for k in range(len(table.get("exposure_time_ns", ()))):
        place = np.array([table[name][k] for name in ("east_m", "north_m", "up_m")], dtype=float)
        horizontal, up = float(table["sigma_horizontal_m"][k]), float(table["sigma_up_m"][k])
        if np.isfinite([*place, horizontal, up]).all():
            P = np.diag([horizontal**2 / 2.0, horizontal**2 / 2.0, up**2])
            time_ns = int(table["exposure_time_ns"][k])
            rows.append(TargetFix(str(table["target_id"][k]), place, P, None, time_ns, 0.0))
    rows.sort(key=lambda fix: fix.exposure_time_ns)
    return np.array([r.exposure_time_ns for r in rows], dtype=np.int64), rows


def _attitudes(tlog: Path | None, utc_minus_monotonic_ns: int) -> tuple[np.ndarray, Array]:
    """Times of ATTITUDE, and (N, 3) roll, pitch, yaw, rad; empty without a log."""
    rows: list[tuple[int, float, float, float]] = []
    if tlog is not None and tlog.is_file():
        for utc_ns, message in read_tlog(tlog):
            if message.get_type() == "ATTITUDE" and message.get_srcComponent() == 1:
                time_ns = utc_ns - utc_minus_monotonic_ns
                rows.append((time_ns, message.roll, message.pitch, message.yaw))
    rows.sort()
    times = np.array([row[0] for row in rows], dtype=np.int64)
    return times, np.array([row[1:] for row in rows], dtype=float).reshape(-1, 3)
