"""Reads a flight's record: tables, and localized frames as a `RecordedFlight`; and checks whether a
map is the one of a record, because it may have been built again since.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from companion.config import CameraModel, CompanionConfig, parse_config
from companion.errors import ConfigError, RecordError
from companion.flight.recorder import MANIFEST_NAME
from companion.preflight.map_pin import map_hash
from companion.recorded.cameras import camera_given
from companion.recorded.flight import (
    LogBeside,
    RecordedFlight,
    RecordedFrame,
    Telemetry,
)
from companion.trajectory import snapshot_name
from localizer.errors import CameraError, GeoreferenceError
from localizer.geometry.camera import Camera
from localizer.geometry.geo import Geodetic
from localizer.geometry.pose import Array, Pose, matrix_from_quaternion
from localizer.map.cache.cache import TileCache
from localizer.plain_files import plain_text

Columns = Mapping[str, np.ndarray]


def read_columns(path: Path, text: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Columns of a CSV file as float64 arrays, NaN where a field is empty; {} without a row.

    Columns named in `text` are strings; columns whose name ends in ``_ns`` are int64, because
    float64 would round them. A last row that a power loss cut short is left out. `RecordError` if
    the file is not a table of a record; OSError or UnicodeDecodeError if it cannot be read.
    """
    lines = io.StringIO(plain_text(path, None), newline="").readlines()
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    try:
        rows = list(csv.DictReader(lines))
    except csv.Error as error:
        raise RecordError(f"{path}: not a table of a record: {error}") from error
    names = rows[0].keys() if rows else []
    columns: dict[str, np.ndarray] = {}
    try:
        for name in names:
            values = [row[name] for row in rows]
            if name in text:
                columns[name] = np.array(values)
            elif name.endswith("_ns"):
                columns[name] = np.array([int(v) for v in values], dtype=np.int64)
            else:
                columns[name] = np.array([float(v) if v else np.nan for v in values])
    except (TypeError, ValueError, OverflowError) as error:
        raise RecordError(f"{path}: not a table of a record: {error}") from error
    return columns


def poses(columns: Columns) -> list[Pose]:
    """Rows with east_m, north_m, up_m and qw..qz as poses world_from_camera."""
    t = np.column_stack([columns[k] for k in ("east_m", "north_m", "up_m")])
    q = np.column_stack([columns[k] for k in ("qw", "qx", "qy", "qz")])
    return [Pose(matrix_from_quaternion(qi), ti) for qi, ti in zip(q, t, strict=True)]


STAGES = ("reference", "extract", "register", "latency")
_LARGEST = 1e9
_DIGITS = 18
_LATEST_NS = 1 << 62  # the year 2116: sums of two still fit 64 bits
_LONGEST_PX = 1e6
MIN_IMAGES = 0.9  # share of the localized frames
_ROW = ("sequence", "latency_ms", "accepted", "east_m", "north_m", "up_m", "qw", "qx", "qy", "qz")
_NEEDED = {
    "estimates.csv": (
        "exposure_time_ns", "east_m", "north_m", "up_m", "qw", "qx", "qy", "qz", "sigma_east_m",
        "sigma_north_m", "quality", "state", "status", "accepted",
        *(f"{name}_ms" for name in STAGES),
    ),
    "targets.csv": (
        "exposure_time_ns", "target_id", "latitude_deg", "longitude_deg", "height_m", "east_m",
        "north_m", "sigma_horizontal_m", "elsewhere",
    ),
    "events.csv": ("time_ns", "level", "text"),
}  # fmt: skip
_PLACE, _POINT = ("latitude_deg", "longitude_deg", "height_m"), ("east_m", "north_m", "up_m")


@dataclass(frozen=True)
class RecordTables:
    """A record's contents.

    health: last health.json, {} without one; notes: missing parts. Only settings that a report
    needs are read, so that records of other versions can be shown.
    """

    folder: Path
    estimates: Columns
    targets: Columns
    events: Columns
    manifest: Mapping[str, Any]
    health: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def start_ns(self) -> int:
        """Start of the record, CLOCK_MONOTONIC ns; else the first estimate's exposure, else 0."""
        return self._time_ns("monotonic_ns") or int(
            next(iter(self.estimates.get("exposure_time_ns", ())), 0)
        )

    @property
    def utc_ns(self) -> int:
        """UTC of `start_ns`, ns; 0 if unknown."""
        return self._time_ns("utc_ns")

    @property
    def settings(self) -> dict[str, Any]:
        """The flown deployment; {} if unknown."""
        return mapping(self.manifest.get("config"))

    @property
    def versions(self) -> dict[str, Any]:
        """Software versions; {} if unknown."""
        return mapping(self.manifest.get("versions"))

    @property
    def map_path(self) -> Path | None:
        """Path of the flown map; None if unknown."""
        named = self._setting("map")
        return Path(named) if isinstance(named, str) else None

    @property
    def flown_map(self) -> FlownMap:
        """Identity of the map that was flown: its hash, and one estimate as latitude, longitude,
        height and as ENU, which shows the map's frame. Each is missing if the record lacks it.
        """
        named = self.manifest.get("map_sha256")
        sha256 = named if isinstance(named, str) else None
        columns = [self.estimates.get(name) for name in (*_PLACE, *_POINT)]
        told = [c for c in columns if c is not None]
        rows = np.column_stack(told) if len(told) == len(columns) else np.zeros((0, 6))
        for row in rows[np.isfinite(rows).all(axis=1)][:1]:
            try:
                return FlownMap(self.folder, sha256, Geodetic(*row[:3]), row[3:])
            except GeoreferenceError:
                break
        return FlownMap(self.folder, sha256)

    @property
    def camera(self) -> Camera | None:
        """The calibrated camera model; None if unknown."""
        try:
            return CameraModel.model_validate(self._setting("camera", "model")).camera()
        except (ValidationError, CameraError):
            return None

    @property
    def tlog(self) -> Path | None:
        """Path of the flight's .tlog: where the settings name it, otherwise in the record or beside
        it. If no such file exists, the path of the settings. None if the flight wrote none.
        """
        named = self._setting("bridge", "tlog")
        if not isinstance(named, str):
            return None
        name = Path(named).name
        places = (Path(named), self.folder / name, self.folder.parent / name)
        return next((path for path in places if path.is_file()), places[0])

    @property
    def delay_ms(self) -> float | None:
        """Setting `bridge.injection.delay_ms` (age at which a fix was sent); None if unknown."""
        return self._number("bridge", "injection", "delay_ms")

    @property
    def alert_limit_m(self) -> float | None:
        """Setting: protection level above which nothing was injected, m; None if unknown."""
        return self._number("bridge", "injection", "alert_limit_m")

    def _number(self, *keys: str) -> float | None:
        value = self._setting(*keys)
        known = isinstance(value, int | float) and abs(value) < _LARGEST  # false for NaN, too
        return float(value) if known else None

    def _time_ns(self, key: str) -> int:
        value = self.manifest.get(key)
        return value if isinstance(value, int) and 0 <= value < _LATEST_NS else 0

    def _setting(self, *keys: str) -> Any:
        value: Any = self.manifest.get("config")
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value


@dataclass(frozen=True)
class RecordedEstimate:
    """One row of ``estimates.csv``. known_ns: time of publication, CLOCK_MONOTONIC; focal_px: focal
    length of its frame, None in old records.
    """

    exposure_time_ns: int
    sequence: int
    known_ns: int
    world_from_camera: Pose
    accepted: bool
    is_tracking: bool = True
    focal_px: float | None = None


@dataclass(frozen=True)
class FlightRecord:
    """A record that can be localized again. flight: frames, one for each of `estimates`, on
    CLOCK_MONOTONIC, and the log; a frame's image may be missing.
    """

    tables: RecordTables
    config: CompanionConfig
    flight: RecordedFlight
    log: LogBeside
    estimates: tuple[RecordedEstimate, ...]

    @property
    def folder(self) -> Path:
        """Folder of the record."""
        return self.tables.folder


def read_record(folder: Path) -> RecordTables:
    """Read the record of `companion run`; `RecordError` for another folder. A flight without an
    estimate has {} as `estimates`.
    """
    try:
        estimates = _table(folder / "estimates.csv", ("state", "status"))
        targets = _table(folder / "targets.csv", ("target_id", "visibility"))
        events = _table(folder / "events.csv", ("level", "text", "alert"))
    except (OSError, UnicodeDecodeError) as error:
        raise RecordError(
            f"{folder}: not a flight's record: {error}; give the folder that "
            "`companion run` recorded (record.folder), or a demo's companion/"
        ) from error
    notes = [
        f"{name} is missing" for name in ("targets.csv", "events.csv")
        if not (folder / name).exists()
    ]  # fmt: skip
    manifest, health = document(folder / MANIFEST_NAME), document(folder / "health.json")
    if not manifest:
        notes.append(f"{MANIFEST_NAME} cannot be read: no settings, no map")
    if not estimates:
        notes.append("the record holds no estimate: nothing was localized in that flight")
    return RecordTables(folder, estimates, targets, events, manifest, health, tuple(notes))


def load_record(
    folder: Path,
    kept_share: float = MIN_IMAGES,
    tlog: Path | None = None,
    map_cache: Path | None = None,
) -> FlightRecord:
    """Load a record to localize it again; `RecordError` says what is missing.

    kept_share: share of the localized frames that must have their image; tlog, map_cache: used
    instead of the record's own.
    """
    tables = read_record(folder)
    if not tables.manifest:
        raise RecordError(
            f"{folder / MANIFEST_NAME}: is missing or damaged; copy the record whole from the "
            "companion's disk"
        )
    try:
        config = parse_config(tables.settings, str(folder / MANIFEST_NAME))
    except ConfigError as error:
        raise RecordError(f"{folder}: not a flight's record: {error}") from error
    estimates = tuple(_estimates(tables.estimates, folder / "estimates.csv"))
    if not estimates:
        raise RecordError(f"{folder}: holds no estimate; nothing was localized in that flight")
    files = [folder / "snapshots" / snapshot_name(e.exposure_time_ns) for e in estimates]
    missing = sum(not file.is_file() for file in files)
    if missing > (1 - kept_share) * len(estimates):
        raise RecordError(
            f"{folder}: {missing} of {len(estimates)} localized frames have no image in snapshots: "
            "fly with record.snapshot_interval_s 0.001 to keep every frame"
        )
    tlog = tlog or tables.tlog
    if tlog is None:
        raise RecordError(f"{folder}: flown without bridge.tlog; give the log as --tlog")
    frames = tuple(
        RecordedFrame(file.name, file, e.exposure_time_ns, Telemetry(e.exposure_time_ns))
        for file, e in zip(files, estimates, strict=True)
    )
    mounted = config.bridge.camera
    fixed_pitch_deg = mounted.mount_pitch_deg if mounted.mount == "fixed" else None
    log = LogBeside(tlog, tables.utc_ns - tables.start_ns, fixed_pitch_deg)
    camera = camera_given(config.camera.model.camera(), MANIFEST_NAME)
    flight = RecordedFlight(folder.name, "video", frames, camera, tables.notes, log)
    if map_cache is not None:
        config = config.model_copy(update={"map": map_cache})
    return FlightRecord(tables, config, flight, log, estimates)


def read_estimates(path: Path) -> tuple[RecordedEstimate, ...]:
    """Read a record's ``estimates.csv``; `RecordError` for an invalid file."""
    try:
        return tuple(_estimates(read_columns(path, ("state", "status")), path))
    except (OSError, UnicodeDecodeError) as error:
        raise RecordError(f"{path}: not a record's estimates: {error}") from error


def _estimates(columns: Columns, path: Path) -> Iterator[RecordedEstimate]:
    """The rows that hold a pose; the last two columns are missing in old records."""
    if not columns:
        return
    lacking = [name for name in _ROW if name not in columns]
    if lacking:
        raise RecordError(f"{path}: not a table of a record: no column {lacking[0]}")
    rows = np.column_stack([columns[name] for name in _ROW])
    stamps = np.asarray(columns["exposure_time_ns"])
    focal = np.asarray(columns.get("focal_px", np.full(len(rows), np.nan)))
    wrong = ~np.isfinite(rows).all(axis=1) | ~rows[:, -4:].any(axis=1) | (stamps < 0)
    wrong |= (focal < 1.0) | (focal > _LONGEST_PX)
    if wrong.any():
        raise RecordError(f"{path}: not a table of a record: the row at {stamps[wrong][0]} is none")
    states = columns.get("state", np.full(len(rows), "tracking"))
    told = zip(stamps, rows, poses(columns), focal, states, strict=True)
    for stamp, row, pose, focal_px, state in told:
        yield RecordedEstimate(
            int(stamp), int(row[0]), int(stamp) + round(1e6 * float(row[1])), pose, row[2] == 1.0,
            state == "tracking", None if np.isnan(focal_px) else float(focal_px),
        )  # fmt: skip


def document(path: Path) -> dict[str, Any]:
    """Read a JSON object of a record; {} if the file is missing or damaged."""
    try:
        return mapping(json.loads(plain_text(path)))
    except (OSError, ValueError, RecursionError):
        return {}


def _table(path: Path, text: tuple[str, ...]) -> Columns:
    """Read a table of a record; {} if it is missing, unless it is the estimates."""
    if path.name != "estimates.csv" and not path.exists():
        return {}
    columns = read_columns(path, text)
    if path.name == "estimates.csv" and path.stat().st_size == 0:
        raise RecordError(f"{path}: is empty, without its header; copy the record again")
    missing = [name for name in _NEEDED[path.name] if name not in columns]
    if columns and missing:
        raise RecordError(f"{path}: not a table of a record: no column {missing[0]}")
    return columns


def mapping(value: Any) -> dict[str, Any]:
    """The value if it is a mapping, else {}."""
    return value if isinstance(value, dict) else {}


def is_time_ns(text: str) -> bool:
    """Whether a snapshot's file name is an exposure time."""
    return text.isascii() and text.isdigit() and len(text) <= _DIGITS


_SAME_FRAME_M = 1.0


@dataclass(frozen=True)
class FlownMap:
    """A record's data about its map. sha256: hash of the map's manifest, None in old records.
    place, point: one pose in WGS84 and in the map's ENU, m; None if not recorded.
    """

    folder: Path
    sha256: str | None = None
    place: Geodetic | None = None
    point: Array | None = None

    def require_frame(self, cache: TileCache) -> None:
        """`RecordError` if the map's origin is not the flight's, because all recorded positions
        would be shifted.
        """
        if self.place is None or self.point is None:
            return
        p = self.place
        here = cache.frame.enu_from_geodetic(p.latitude_deg, p.longitude_deg, p.height_m)
        away_m = float(np.linalg.norm(here - self.point))
        if away_m > _SAME_FRAME_M:
            raise RecordError(
                f"{self.folder}: flown over a map about another origin than {cache.path}, "
                f"{away_m:.0f} m away: was it built again since? give the flight's own as --map"
            )

    def mismatch(self, cache: TileCache) -> str:
        """A warning if the map's hash is not the flown one's; "" if it is, or none was recorded."""
        try:
            same = self.sha256 in (None, map_hash(cache.path))
        except ConfigError as error:
            return str(error)
        if same:
            return ""
        return (
            f"{cache.path} is not the map that was flown over: was it built again since? what "
            "differs from the flight may be the map's"
        )
