"""Exports a flight's record as one MCAP file."""

from __future__ import annotations

import heapq
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import ConfigError, RecordError, ReportError
from companion.offline.record import Columns, RecordTables, is_time_ns, read_record
from companion.writing import result_file
from localizer.errors import LocalizerError
from localizer.map.cache.cache import TileCache
from localizer.plain_files import plain_bytes
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.tlog import read_tlog

Step = tuple[int, Callable[[], None]]  # time (ns of UTC), what writes it
MCAP_NAME = "record.mcap"
_FIX_3D = 3


@dataclass(frozen=True)
class ExportResult:
    """Result of an export. rows: rows, images and MAVLink messages read; messages: written, of all
    topics; notes: missing parts of the record.
    """

    path: Path
    messages: int
    rows: int
    notes: tuple[str, ...]


def require_extra() -> None:
    """`ConfigError` if the packages of the extra `mcap` are not installed."""
    try:
        import_module("companion.export.mcap_file")
    except ImportError as error:
        raise ConfigError(
            "MCAP needs its packages: pip install -e '.[mcap]' in a checkout, with the pip of the "
            f"program's environment: {error}"
        ) from error


def record_folder(folder: Path) -> Path:
    """The record in a demo's folder, or the folder itself."""
    inside = folder / "companion"
    return inside if (inside / "estimates.csv").exists() else folder


def export_mcap(
    folder: Path,
    out: Path | None = None,
    tlog: Path | None = None,
    progress: Callable[[int], None] = lambda _: None,
) -> ExportResult:
    """Write the record's rows, images and MAVLink messages in the order of their times.

    out: ``record.mcap`` in the record if None; tlog: another file than the record's own; progress:
    called now and then with the number of rows written. `RecordError` for a folder that is no
    record, `ReportError` if the file cannot be written (an existing one then stays), `ConfigError`
    as of `require_extra`.
    """
    folder = record_folder(folder)
    tables = read_record(folder)
    require_extra()
    from companion.export.mcap_file import McapFile

    path = result_file(out or folder / MCAP_NAME, "--out", (".mcap",))
    partial = path.with_name(f".{path.name}.part")
    notes = list(tables.notes)
    if not tables.utc_ns:
        notes.append("the record does not say what time it was: times count from the machine's")
    offset_ns = tables.utc_ns - tables.start_ns if tables.utc_ns else 0
    count = 0
    try:
        file = McapFile(partial, offset_ns, tables.camera)
        try:
            steps = heapq.merge(*_sources(file, tables, tlog, offset_ns, notes), key=itemgetter(0))
            for _, write in steps:
                write()
                count += 1
                if count % 500 == 0:
                    progress(count)
            for name in ("record.json", "health.json"):
                if (folder / name).is_file():
                    file.attach(folder / name)
        finally:
            file.close()
        os.replace(partial, path)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from error
    finally:
        partial.unlink(missing_ok=True)
    progress(count)
    return ExportResult(path, file.messages, count, tuple(notes))


def _sources(
    file: Any, tables: RecordTables, tlog: Path | None, offset_ns: int, notes: list[str]
) -> list[Iterable[Step]]:
    steps: list[Iterable[Step]] = [
        _rows(tables.estimates, "exposure_time_ns", offset_ns, file.estimate),
        _rows(tables.targets, "exposure_time_ns", offset_ns, file.target),
        _rows(tables.events, "time_ns", offset_ns, file.event),
        _pictures(tables.folder, offset_ns, file.image),
    ]
    path = tlog or tables.tlog
    if path is None:
        notes.append("flown without bridge.tlog: no MAVLink text, no track of the autopilot")
        return steps
    try:
        steps.append(sorted(_mavlink(file, path, tables), key=itemgetter(0)))
    except (BridgeError, OSError) as error:
        notes.append(f"no MAVLink: {error}")
    return steps


def _rows(
    columns: Columns, time: str, offset_ns: int, take: Callable[[dict[str, Any]], None]
) -> Iterator[Step]:
    if not columns:
        return
    names = list(columns)
    for i in np.argsort(columns[time], kind="stable"):
        row = {name: columns[name][i] for name in names}
        yield int(row[time]) + offset_ns, partial(take, row)


def _pictures(folder: Path, offset_ns: int, take: Callable[[bytes, int], None]) -> Iterator[Step]:
    paths = (p for p in (folder / "snapshots").glob("*.jpg") if is_time_ns(p.stem))
    for path in sorted(paths, key=lambda p: int(p.stem)):
        time_ns = int(path.stem)
        yield time_ns + offset_ns, partial(_take_picture, take, path, time_ns)


def _take_picture(take: Callable[[bytes, int], None], path: Path, time_ns: int) -> None:
    """Read an image when its time comes: the images of a flight do not fit in memory together."""
    take(plain_bytes(path), time_ns)


def _mavlink(file: Any, path: Path, tables: RecordTables) -> Iterator[Step]:
    """STATUSTEXT and positions of autopilot and receiver, from the .tlog. What it holds from before
    the record is of an earlier flight and left out.
    """
    from companion.export import messages

    geoid_m = _geoid_separation_m(tables)
    for time_ns, message in read_tlog(path):
        if time_ns < tables.utc_ns:
            continue
        kind = message.get_type()
        made: Any = None
        if kind == "STATUSTEXT":
            sender = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
            topic, text = "/mavlink/text", str(message.text).rstrip("\0")
            made = messages.status_text(text, int(message.severity), sender, time_ns)
        elif kind in ("GLOBAL_POSITION_INT", "GPS_RAW_INT") and (message.lat or message.lon):
            place = (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3 + geoid_m)
            if kind == "GLOBAL_POSITION_INT":
                topic, frame, sigma_m = "/autopilot/location", messages.AUTOPILOT, None
            elif message.fix_type >= _FIX_3D:
                topic, frame = "/gnss/location", messages.RECEIVER
                sigma_m = message.h_acc * 1e-3 if message.h_acc else None
            else:
                continue
            made = messages.reported_location(frame, place, sigma_m, time_ns)
        if made is not None:
            yield time_ns, partial(file.put, topic, made, time_ns)


def _geoid_separation_m(tables: RecordTables) -> float:
    """Geoid above the ellipsoid at the flown map, m, because MAVLink's altitudes are AMSL."""
    if tables.map_path is None:
        raise RecordError("the record does not say which map was flown on, so no height is known")
    try:
        return float(TileCache.open(tables.map_path).manifest.geoid_separation_m)
    except LocalizerError as error:
        raise RecordError(f"no height without the map: {error}") from error
