"""A recorded flight localized again: the same frames and the same MAVLink, frame after frame.

Without threads, so that a machine of any speed gives the same result: each frame that was localized
in flight is localized again, with what the autopilot had said by then.
"""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.config import CompanionConfig, parse_config
from companion.conversions import CameraExtrinsics
from companion.errors import RecordError, StreamDecodeError
from companion.flight.priors import AutopilotPose
from companion.flight.recorder import MANIFEST_NAME
from companion.offline.autopilot import RecordedAutopilot
from companion.offline.flown_map import FlownMap
from companion.sources.base import fitted_camera
from companion.sources.folder_source import read_image
from companion.sources.zoom import ZoomTable, longer
from companion.trajectory import snapshot_name
from localizer.errors import GeoreferenceError, OutsideMapError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion
from localizer.plain_files import plain_text
from localizer.tracking.opening import MapStack, build_localizer
from localizer.tracking.pipeline import Localizer
from localizer.types import Frame, PoseEstimate

_log = logging.getLogger(__name__)
_LONGEST_PX = 1e6
_ALIKE = 1e-3  # a share of the focal length that is no other lens
_MIN_IMAGES = 0.9  # share of the localized frames


@dataclass(frozen=True)
class RecordedEstimate:
    """One row of ``estimates.csv``. known_ns: when it was published, CLOCK_MONOTONIC; focal_px: of
    its frame, None in records from before it was written; place: of the same pose, by the flown
    map's frame, None where it is not written.
    """

    exposure_time_ns: int
    sequence: int
    known_ns: int
    world_from_camera: Pose
    accepted: bool
    is_tracking: bool = True
    focal_px: float | None = None
    place: Geodetic | None = None


@dataclass(frozen=True)
class FlightRecord:
    """A record's folder, read. start_ns: of the record, CLOCK_MONOTONIC; utc_minus_monotonic_ns: of
    the machine, then; map_sha256: of the flown map's manifest, None in older records.
    """

    folder: Path
    config: CompanionConfig
    start_ns: int
    utc_minus_monotonic_ns: int
    estimates: tuple[RecordedEstimate, ...]
    map_sha256: str | None = None

    @property
    def flown(self) -> FlownMap:
        """What it knows of the map that it was flown over."""
        for estimate in self.estimates:
            if estimate.place is not None:
                point = estimate.world_from_camera.translation
                return FlownMap(self.folder, self.map_sha256, estimate.place, point)
        return FlownMap(self.folder, self.map_sha256)


@dataclass(frozen=True)
class ReplayedFrame:
    """One frame's two outcomes. replayed: None where its prediction left the map, or no prior."""

    recorded: RecordedEstimate
    replayed: PoseEstimate | None


@dataclass(frozen=True)
class ReplaySummary:
    """How a replay compares. Differences are over frames accepted both times."""

    frames: int
    accepted_recorded: int
    accepted_replayed: int
    accepted_both: int
    translation_m: Array
    rotation_deg: Array

    def agrees(self, tolerance_m: float) -> bool:
        """Whether at least 95 per cent of what was accepted in flight is accepted again, and 95 per
        cent of that within `tolerance_m` of where it was.
        """
        if self.accepted_recorded == 0:
            return self.accepted_replayed == 0
        if self.accepted_both < 0.95 * self.accepted_recorded:
            return False
        return bool(np.percentile(self.translation_m, 95) <= tolerance_m)


def load_record(folder: Path, kept_share: float = _MIN_IMAGES) -> FlightRecord:
    """Read a record that `companion run` left. `RecordError` says what it lacks.

    kept_share: of the localized frames that must have their picture.
    """
    try:
        manifest = json.loads(plain_text(folder / MANIFEST_NAME))
        start_ns = int(manifest["monotonic_ns"])
        offset_ns = int(manifest["utc_ns"]) - start_ns
        config = parse_config(manifest["config"], str(folder / MANIFEST_NAME))
        estimates = _estimates(folder / "estimates.csv")
    # RecursionError: endless nesting.
    except (
        OSError, ValueError, KeyError, TypeError, ArithmeticError, RecursionError, csv.Error,
        GeoreferenceError,
    ) as error:  # fmt: skip
        raise RecordError(
            f"{folder}: not a flight's record: {error}; give the folder that "
            "`companion run` recorded (record.folder), or a demo's companion/"
        ) from error
    if not estimates:
        raise RecordError(f"{folder}: holds no estimate; nothing was localized in that flight")
    missing = sum(not image_path(folder, e).is_file() for e in estimates)
    if missing > (1 - kept_share) * len(estimates):
        raise RecordError(
            f"{folder}: {missing} of {len(estimates)} localized frames have no image in snapshots: "
            "fly with record.snapshot_interval_s 0.001 to keep every frame"
        )
    told = manifest.get("map_sha256")
    sha256 = told if isinstance(told, str) else None
    return FlightRecord(folder, config, start_ns, offset_ns, estimates, sha256)


def read_estimates(path: Path) -> tuple[RecordedEstimate, ...]:
    """The rows of a record's ``estimates.csv``. `RecordError` says why it is none."""
    try:
        return _estimates(path)
    except (
        OSError, ValueError, KeyError, TypeError, ArithmeticError, csv.Error, GeoreferenceError
    ) as error:  # fmt: skip
        raise RecordError(f"{path}: not a record's estimates: {error}") from error


def _estimates(path: Path) -> tuple[RecordedEstimate, ...]:
    text = io.StringIO(plain_text(path, None), newline="")
    return tuple(_estimate(row) for row in _whole_rows(text))


def _whole_rows(file: io.StringIO) -> Iterator[dict[str, str]]:
    """The rows, without a last one that a loss of power cut short."""
    lines = file.readlines()
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    return csv.DictReader(lines)


def _estimate(row: dict[str, str]) -> RecordedEstimate:
    exposure_ns = int(row["exposure_time_ns"])
    q = np.array([float(row[k]) for k in ("qw", "qx", "qy", "qz")])
    t = np.array([float(row[k]) for k in ("east_m", "north_m", "up_m")])
    if not np.isfinite([*q, *t]).all() or not np.any(q) or not 0 <= exposure_ns < 1 << 63:
        raise ValueError(f"estimates.csv: the estimate at {exposure_ns} is no pose")
    return RecordedEstimate(
        exposure_ns,
        int(row["sequence"]),
        exposure_ns + round(1e6 * float(row["latency_ms"])),
        Pose(matrix_from_quaternion(q), t),
        row["accepted"] == "1",
        row.get("state", "tracking") == "tracking",
        _focal(row.get("focal_px") or None, exposure_ns),
        _place(row),
    )


def _place(row: dict[str, str]) -> Geodetic | None:
    told = [row.get(k) for k in ("latitude_deg", "longitude_deg", "height_m")]
    numbers = [float(text) for text in told if text]
    return Geodetic(*numbers) if len(numbers) == len(told) else None


def _focal(text: str | None, exposure_ns: int) -> float | None:
    focal = None if text is None else float(text)
    if focal is not None and not 1.0 <= focal <= _LONGEST_PX:
        raise ValueError(f"estimates.csv: {focal} px at {exposure_ns} is no focal length")
    return focal


def image_path(folder: Path, estimate: RecordedEstimate) -> Path:
    """Where a record keeps the estimate's picture, if it was kept."""
    return folder / "snapshots" / snapshot_name(estimate.exposure_time_ns)


def replay(
    record: FlightRecord, tlog: Path, progress: Callable[[], None] = lambda: None
) -> list[ReplayedFrame]:
    """Localize the recorded frames again, over the map and with the settings of the record."""
    config = record.config
    autopilot = RecordedAutopilot(
        config.bridge, tlog, record.start_ns, record.utc_minus_monotonic_ns
    )
    stack = MapStack(config.map, config.localizer)
    try:
        camera = config.camera.model.camera()
        cache = stack.cache
        record.flown.require_frame(cache)
        arm = np.array(config.camera.lever_arm_m)
        extrinsics = CameraExtrinsics(cache.frame, cache.manifest.geoid_separation_m, arm)
        pose = AutopilotPose(autopilot, extrinsics, config.prior)
        localizer = build_localizer(stack, camera, config.localizer, pose.sensors)
        frames, unzoomed = [], 0
        for recorded in record.estimates:
            progress()
            if not (path := image_path(record.folder, recorded)).is_file():
                continue
            autopilot.advance(recorded.known_ns)
            if localizer.tracker.track_status.wants_prior:
                prior = pose.prior(recorded.exposure_time_ns)
                if prior is not None:
                    localizer.offer(prior)
            factor = _told_factor(config.camera.zoom, autopilot, recorded)
            if factor is None:  # a fix of it would be metres off and look as good as any
                unzoomed += 1
                frames.append(ReplayedFrame(recorded, None))
                continue
            try:
                again = _localize(localizer, longer(camera, factor), recorded, path)
            except StreamDecodeError as error:  # power may have gone while it was written
                _log.warning("left out: %s", error)
                continue
            if again is not None and again.accepted:
                pose.belief.note_fix(again.exposure_time_ns)
            frames.append(ReplayedFrame(recorded, again))
        if unzoomed:
            _log.warning(
                "%d of %d pictures are not localized again: neither estimates.csv nor %s tells "
                "the zoom that they were taken with", unzoomed, len(record.estimates), tlog,
            )  # fmt: skip
        if len(frames) < _MIN_IMAGES * len(record.estimates):
            raise RecordError(
                f"{record.folder}: only {len(frames)} of {len(record.estimates)} images in "
                "snapshots can be read; nothing can be said about this flight"
            )
        return frames
    finally:
        stack.close()


def _told_factor(
    zoom: ZoomTable | None, autopilot: RecordedAutopilot, recorded: RecordedEstimate
) -> float | None:
    """Multiple of the model's focal length that the log tells of a frame whose row does not, as in
    older records; 1 where none is needed, None where nobody tells.
    """
    if zoom is None or recorded.focal_px is not None:
        return 1.0
    level = autopilot.zoom_at(recorded.exposure_time_ns, zoom.hold_s)
    return None if level is None else zoom.factor(level)


def _localize(
    localizer: Localizer, camera: Camera, recorded: RecordedEstimate, path: Path
) -> PoseEstimate | None:
    image = read_image(path)
    fitted = fitted_camera(image.shape[1], image.shape[0], camera, str(path))
    if recorded.focal_px is not None:
        factor = recorded.focal_px / fitted.fx
        fitted = longer(fitted, factor) if abs(factor - 1.0) > _ALIKE else fitted
    frame = Frame(image, recorded.exposure_time_ns, fitted, recorded.sequence)
    try:
        return localizer.track(frame)
    except OutsideMapError:
        return None


def summarize(frames: list[ReplayedFrame]) -> ReplaySummary:
    """Compare the two outcomes of every frame."""
    again = [f.replayed is not None and f.replayed.accepted for f in frames]
    differences = [
        f.recorded.world_from_camera.distance_to(f.replayed.world_from_camera)
        for f in frames
        if f.replayed is not None and f.replayed.accepted and f.recorded.accepted
    ]
    values = np.array(differences).reshape(-1, 2)
    return ReplaySummary(
        len(frames), sum(f.recorded.accepted for f in frames), sum(again), len(values),
        values[:, 0], values[:, 1],
    )  # fmt: skip
