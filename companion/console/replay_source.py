"""A finished flight as a source: plays its record, with a time bar.

The map's view of a kept frame is rendered again at the recorded pose. The positions of autopilot
and GNSS receiver come from the .tlog.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np

from companion.console.source import ConsoleSource, sample_of
from companion.errors import StreamDecodeError
from companion.live.protocol import Message
from companion.live.shown import pose_data
from companion.offline.record import Columns, RecordTables, is_time_ns, poses
from companion.reporting.pictures import MapPictures
from companion.reporting.record import AutopilotTracks, TimedTrack, read_autopilot
from companion.sources.folder_source import read_image
from localizer.geometry.camera import Camera
from localizer.geometry.pose import Pose

ABSURD = 1e12  # no measurement
_TARGET_NUMBERS = (
    "latitude_deg", "longitude_deg", "height_m", "cov_ee", "cov_en", "cov_nn",
    "sigma_horizontal_m", "sigma_up_m", "elsewhere",
)  # fmt: skip


def last_row(columns: Columns, name: str, now_ns: int) -> int | None:
    """Index of the last row whose column `name` is at or before now_ns; None without one."""
    if not columns:
        return None
    row = int(np.searchsorted(columns[name], now_ns, side="right")) - 1
    return row if row >= 0 else None


def estimate_of(columns: Columns, row: int) -> dict[str, Any]:
    """One row of the estimates as JSON data; NaN becomes None."""

    def number(name: str) -> float | None:
        value = float(columns[name][row]) if name in columns else float("nan")
        return value if abs(value) < ABSURD else None  # false for NaN, too

    east, north = (number(f"sigma_{axis}_m") or 0.0 for axis in ("east", "north"))
    return {
        "time_ns": int(columns["exposure_time_ns"][row]),
        "latitude_deg": number("latitude_deg"),
        "longitude_deg": number("longitude_deg"),
        "height_m": number("height_m"),
        "heading_deg": _heading_deg(columns, row),
        "covariance_m2": [[east**2, 0.0], [0.0, north**2]],
        "sigma_m": max(east, north),
        "state": str(columns["state"][row]),
        "accepted": bool(columns["accepted"][row] > 0),
        "last_fix_ns": _last_fix_ns(columns, row),
        "quality": number("quality"),
        "hpl_m": number("hpl_m"),
        "stages_ms": {
            name: number(f"{name}_ms") for name in ("reference", "extract", "register", "latency")
        },
    }


def _last_fix_ns(columns: Columns, row: int) -> int | None:
    accepted = np.flatnonzero(np.asarray(columns["accepted"][: row + 1]) > 0)
    return int(columns["exposure_time_ns"][accepted[-1]]) if len(accepted) else None


def _heading_deg(columns: Columns, row: int) -> float | None:
    """Direction of the image's top or of the camera's axis, whichever is flatter."""
    w, x, y, z = (float(columns[k][row]) for k in ("qw", "qx", "qy", "qz"))
    forward = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    up = (-2 * (x * y - w * z), -(1 - 2 * (x * x + z * z)))
    ahead = forward[:2] if abs(forward[2]) < 0.98 else up
    heading = float(np.degrees(np.arctan2(ahead[0], ahead[1])) % 360.0)
    return heading if np.isfinite(heading) else None


def target_of(columns: Columns, name: str, row: int) -> dict[str, Any] | None:
    """One row of a target as JSON data; None if a number is missing."""
    numbers = {key: float(columns[key][row]) for key in _TARGET_NUMBERS if key in columns}
    if len(numbers) < len(_TARGET_NUMBERS) or not all(map(np.isfinite, numbers.values())):
        return None
    ee, en, nn = (numbers.pop(key) for key in ("cov_ee", "cov_en", "cov_nn"))
    return {
        "name": name,
        "time_ns": int(columns["exposure_time_ns"][row]),
        "sigma_m": numbers.pop("sigma_horizontal_m"),
        **numbers,
        "amsl_m": None,
        "covariance_m2": [[ee, en], [en, nn]],
        "pixel": _pixel(columns, row),
    }


def _pixel(columns: Columns, row: int) -> list[float] | None:
    """Pixel of the target in its frame; None if it was not seen."""
    pixel = [float(columns[k][row]) for k in ("u", "v") if k in columns]
    return pixel if len(pixel) == 2 and all(abs(x) < ABSURD for x in pixel) else None


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


_STEP_S = 0.5
_PLOTTED = 600  # seconds before a place of the time bar that plots and tracks begin with
_RATE_S, _LATENCY_S = 3.0, 10.0  # over which rate and latency are reported
_HEARD_NS = 2_000_000_000  # a place of autopilot or receiver holds so long


class ReplaySource(ConsoleSource):
    """Plays the record's rows at their original speed. pictures: renderer of the map; without it
    there is neither the map view nor the autopilot's track.
    """

    def __init__(self, tables: RecordTables, pictures: MapPictures | None = None) -> None:
        super().__init__()
        self._tables = tables
        self._map = pictures
        self._tracks = AutopilotTracks()
        if pictures is not None:
            clock = tables.start_ns, tables.utc_ns
            self._tracks = read_autopilot(tables.tlog, *clock, pictures)
        self._residuals = self._gnss_residuals()
        times = tables.estimates.get("exposure_time_ns", np.empty(0, np.int64))
        self._start_ns = int(times[0]) if len(times) else 0
        self._length_s = (int(times[-1]) - self._start_ns) * 1e-9 if len(times) else 0.0
        self._at_s = 0.0
        self._playing = True
        self._told = 0
        self._pictures = KeptPictures(tables, pictures)

    async def order(self, order: dict[str, Any]) -> tuple[bool, str]:
        """Jump (share: part of the flight, 0 to 1), else go on or pause (play); whether it is
        either, and a text.
        """
        share, play = order.get("share"), order.get("play")
        if isinstance(share, int | float) and 0 <= share <= 1:
            self._at_s = float(share) * self._length_s
            self._told = 0
            self._fill_samples()
        elif isinstance(play, bool):
            self._playing = play
        else:
            return False, "share is 0 to 1, play true or false"
        await self._show()
        return True, "done"

    async def run(self) -> None:
        """Play until cancelled; pauses at the end of the record."""
        limits = {"delay_ms": self._tables.delay_ms, "alert_limit_m": self._tables.alert_limit_m}
        self.newest.add(Message({"kind": "hello", "mode": "record", **limits}))
        while True:
            await self._show()
            await asyncio.sleep(_STEP_S)
            if self._playing:
                self._at_s = min(self._at_s + _STEP_S, self._length_s)

    async def _show(self) -> None:
        now_ns = self._start_ns + round(self._at_s * 1e9)
        self.newest.add(Message(self._state(now_ns)))
        await self._take_picture(now_ns)
        self._wake_waiters()

    def _fill_samples(self) -> None:
        """Fill plots and tracks up to the time of the time bar."""
        self.newest.samples.clear()
        told, self._told = self._told, len(self._tables.events.get("time_ns", ()))
        first_s = max(self._at_s - _PLOTTED, 0.0)
        for at_s in np.arange(first_s, self._at_s, 1.0):
            state = self._state(self._start_ns + round(at_s * 1e9))
            self.newest.samples.append(sample_of(state))
        self._told = told

    def _gnss_residuals(self) -> np.ndarray | None:
        gnss = self._tracks.gnss
        return None if gnss is None else gnss.distance_to(self._tables.estimates)

    def _state(self, now_ns: int) -> dict[str, Any]:
        tables = self._tables
        row = last_row(tables.estimates, "exposure_time_ns", now_ns)
        utc_ns = tables.utc_ns - tables.start_ns + now_ns
        estimate = None if row is None else estimate_of(tables.estimates, row)
        state = "-" if estimate is None else str(estimate["state"])
        level = {"tracking": "ok", "lost": "failed"}.get(state, "degraded")
        return {
            "kind": "state", "time_ns": now_ns, "utc_ns": utc_ns,
            "health": {
                "level": level, "text": f"record of {tables.folder.name}",
                "rate_hz": self._rate_hz(now_ns),
                "guardian": {"hpl_m": None if estimate is None else estimate.pop("hpl_m")},
                "stages_ms": {"latency": {"p95": self._latency_ms(now_ns)}},
            },
            "vehicle": self._vehicle(now_ns), "shadow": None, "follows": None, "injecting": False,
            "estimate": estimate, "gnss_residual_m": self._residual(row), "machine": {},
            "targets": self._targets(now_ns), "events": self._events(now_ns),
            "replay": {
                "at_s": self._at_s, "length_s": self._length_s, "playing": self._playing
            },
        }  # fmt: skip

    def _rows(self, now_ns: int, seconds: float) -> slice:
        """The rows of the estimates of the last `seconds`."""
        times = self._tables.estimates.get("exposure_time_ns", np.empty(0, np.int64))
        ends = np.searchsorted(times, [now_ns - round(seconds * 1e9), now_ns], side="right")
        return slice(int(ends[0]), int(ends[1]))

    def _rate_hz(self, now_ns: int) -> float | None:
        rows = self._rows(now_ns, _RATE_S)
        elapsed_s = min(_RATE_S, (now_ns - self._start_ns) * 1e-9)
        return (rows.stop - rows.start) / elapsed_s if elapsed_s >= 1.0 else None

    def _latency_ms(self, now_ns: int) -> float | None:
        column = self._tables.estimates.get("latency_ms")
        values = () if column is None else column[self._rows(now_ns, _LATENCY_S)]
        known = [float(v) for v in values if abs(v) < ABSURD]  # false for NaN, too
        return float(np.percentile(known, 95)) if known else None

    def _residual(self, row: int | None) -> float | None:
        if row is None or self._residuals is None:
            return None
        value = float(self._residuals[row])
        return value if np.isfinite(value) else None

    def _vehicle(self, now_ns: int) -> dict[str, Any]:
        ekf, gnss = (self._place(track, now_ns) for track in (self._tracks.ekf, self._tracks.gnss))
        told: dict[str, Any] = {}
        if ekf is not None:
            told |= {"latitude_deg": ekf[0], "longitude_deg": ekf[1]}
        if gnss is not None:
            told |= {"gps_latitude_deg": gnss[0], "gps_longitude_deg": gnss[1], "gps_fix_type": 3}
        return told

    def _place(self, track: TimedTrack | None, now_ns: int) -> tuple[float, float] | None:
        """Latitude and longitude, degrees, of a track at now_ns; None if it is outdated."""
        if track is None or self._map is None or self._map.cache is None:
            return None
        i = int(np.searchsorted(track.time_ns, now_ns, side="right")) - 1
        if i < 0 or now_ns - int(track.time_ns[i]) > _HEARD_NS:
            return None
        at = self._map.cache.frame.position([*track.points[i], 0.0])
        return at.latitude_deg, at.longitude_deg

    def _targets(self, now_ns: int) -> list[dict[str, Any]]:
        """Each target's last fix of the last ten seconds."""
        columns = self._tables.targets
        if not columns:
            return []
        times = columns["exposure_time_ns"]
        rows = np.flatnonzero((times <= now_ns) & (times > now_ns - 10_000_000_000))
        newest = {str(columns["target_id"][i]): int(i) for i in rows}
        return [t for name, i in newest.items() if (t := target_of(columns, name, i)) is not None]

    def _events(self, now_ns: int) -> list[dict[str, Any]]:
        columns = self._tables.events
        if not columns:
            return []
        upto = int(np.searchsorted(columns["time_ns"], now_ns, side="right"))
        rows, self._told = range(self._told, max(upto, self._told)), max(upto, self._told)
        return [
            {
                "number": i + 1, "time_ns": int(columns["time_ns"][i]),
                "level": str(columns["level"][i]), "text": str(columns["text"][i]),
            }
            for i in rows
        ]  # fmt: skip

    async def _take_picture(self, now_ns: int) -> None:
        """Send the newest kept frame, if it is another than the last."""
        message = await asyncio.to_thread(self._pictures.newest, now_ns)
        if message is not None:
            self.newest.add(message)
