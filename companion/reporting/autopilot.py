"""Reads EKF and receiver tracks from the .tlog of a flight."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.offline.tables import Columns
from companion.reporting.pictures import MapPictures
from localizer.geometry.geo import LocalFrame
from mavlink_bridge.errors import BridgeError
from mavlink_bridge.link.tlog import read_tlog

_WITHIN_S = 0.5
_FIX_3D = 3


@dataclass(frozen=True)
class TimedTrack:
    """time_ns: (N,), reception time, CLOCK_MONOTONIC; points: (N, 2) east, north, m."""

    time_ns: np.ndarray
    points: np.ndarray

    def distance_to(self, estimates: Columns) -> np.ndarray:
        """Horizontal distance (E,) from each accepted estimate to the track, interpolated; NaN
        without a near sample.

        The distance contains the lever arm, and the delay of the messages times the speed.
        """
        times = np.asarray(estimates["exposure_time_ns"])
        begin = int(self.time_ns[0])
        known, wanted = (self.time_ns - begin) * 1e-9, (times - begin) * 1e-9
        at = [np.interp(wanted, known, self.points[:, i]) for i in (0, 1)]
        gap = np.abs(known[np.clip(np.searchsorted(known, wanted), 0, len(known) - 1)] - wanted)
        distance = np.hypot(estimates["east_m"] - at[0], estimates["north_m"] - at[1])
        usable = (gap < _WITHIN_S) & (np.asarray(estimates["accepted"]) > 0)
        return np.where(usable, distance, np.nan)


@dataclass(frozen=True)
class AutopilotTracks:
    """EKF and GNSS tracks; None if not recorded."""

    ekf: TimedTrack | None = None
    gnss: TimedTrack | None = None


def read_autopilot(
    tlog: Path | None, start_ns: int, utc_ns: int, pictures: MapPictures
) -> AutopilotTracks:
    """Read the tracks from the record's `bridge.tlog`, in the frame of the map that `pictures` has
    open. None without log, map or UTC; a log that cannot be read is noted in `pictures.notes`.
    start_ns, utc_ns: the record's begin on CLOCK_MONOTONIC and in UTC, 0 if unknown.
    """
    if tlog is None or pictures.cache is None or not utc_ns:
        return AutopilotTracks()
    try:
        return _tracks(tlog, utc_ns - start_ns, start_ns, pictures.cache.frame)
    except (BridgeError, OSError) as error:
        pictures.notes.append(f"no track of the autopilot: {error}")
        return AutopilotTracks()


def _tracks(path: Path, offset_ns: int, start_ns: int, frame: LocalFrame) -> AutopilotTracks:
    rows: dict[str, list[tuple[int, float, float]]] = {"GLOBAL_POSITION_INT": [], "GPS_RAW_INT": []}
    for utc_ns, message in read_tlog(path):
        kind = message.get_type()
        if kind not in rows or utc_ns - offset_ns < start_ns:
            continue
        if kind == "GPS_RAW_INT" and message.fix_type < _FIX_3D:
            continue
        rows[kind].append((utc_ns - offset_ns, message.lat * 1e-7, message.lon * 1e-7))
    return AutopilotTracks(
        _track(rows["GLOBAL_POSITION_INT"], frame), _track(rows["GPS_RAW_INT"], frame)
    )


def _track(rows: list[tuple[int, float, float]], frame: LocalFrame) -> TimedTrack | None:
    height = frame.origin.height_m
    places = [
        (t, frame.enu_from_geodetic(lat, lon, height)[:2])
        for t, lat, lon in sorted(rows)
        if abs(lat) <= 90.0 and (lat, lon) != (0.0, 0.0)
    ]
    if not places:
        return None
    return TimedTrack(np.array([t for t, _ in places]), np.array([p for _, p in places]))
