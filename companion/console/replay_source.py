"""A finished flight as a source of the page: its record, played, with a time bar."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import numpy as np

from companion.console.source import Newest
from companion.errors import StreamDecodeError
from companion.live.protocol import Message
from companion.offline.tables import Columns
from companion.reporting.record import RecordTables, is_time_ns
from companion.sources.folder_source import read_image

_STEP_S = 0.5
_ABSURD = 1e12  # no measurement
_TARGET_NUMBERS = (
    "latitude_deg", "longitude_deg", "height_m", "cov_ee", "cov_en", "cov_nn",
    "sigma_horizontal_m", "sigma_up_m", "elsewhere",
)  # fmt: skip


class ReplaySource:
    """Plays the record's rows at the pace at which they were flown."""

    def __init__(self, tables: RecordTables) -> None:
        self._tables = tables
        self.newest = Newest()
        times = tables.estimates.get("exposure_time_ns", np.empty(0, np.int64))
        self._start_ns = int(times[0]) if len(times) else 0
        self._length_s = (int(times[-1]) - self._start_ns) * 1e-9 if len(times) else 0.0
        self._at_s = 0.0
        self._playing = True
        self._told = 0
        self._event = asyncio.Event()
        paths = (tables.folder / "snapshots").glob("*.jpg")
        self._pictures = sorted((int(p.stem), p) for p in paths if is_time_ns(p.stem))
        self._shown: int | None = None

    @property
    def is_connected(self) -> bool:
        """A record is always there."""
        return True

    def watch(self, wanted: bool) -> None:
        """Pictures are read when their time comes, wanted or not."""

    async def changed(self) -> None:
        """Returns with the next step."""
        await self._event.wait()

    async def order(self, order: dict[str, Any]) -> tuple[bool, str]:
        """share: go to that part of the flight, 0 to 1; play: go on, or stand still."""
        share, play = order.get("share"), order.get("play")
        if isinstance(share, int | float) and 0 <= share <= 1:
            self._at_s = float(share) * self._length_s
            self._told = 0
            self.newest.samples.clear()
        elif isinstance(play, bool):
            self._playing = play
        else:
            return False, "share is 0 to 1, play true or false"
        self._show()
        return True, "done"

    async def run(self) -> None:
        """Play until cancelled; at the end it stands."""
        self.newest.take(Message({"kind": "hello", "mode": "record", **self._limits()}))
        while True:
            self._show()
            await asyncio.sleep(_STEP_S)
            if self._playing:
                self._at_s = min(self._at_s + _STEP_S, self._length_s)

    def _limits(self) -> dict[str, Any]:
        return {"delay_ms": self._tables.delay_ms, "alert_limit_m": self._tables.alert_limit_m}

    def _show(self) -> None:
        now_ns = self._start_ns + round(self._at_s * 1e9)
        self.newest.take(Message(self._state(now_ns)))
        self._take_picture(now_ns)
        event, self._event = self._event, asyncio.Event()
        event.set()

    def _state(self, now_ns: int) -> dict[str, Any]:
        tables = self._tables
        row = _last(tables.estimates, "exposure_time_ns", now_ns)
        utc_ns = tables.utc_ns - tables.start_ns + now_ns
        estimate = None if row is None else _estimate(tables.estimates, row)
        state = "-" if estimate is None else str(estimate["state"])
        level = {"tracking": "ok", "lost": "failed"}.get(state, "degraded")
        return {
            "kind": "state", "time_ns": now_ns, "utc_ns": utc_ns,
            "health": {
                "level": level, "text": f"record of {tables.folder.name}", "rate_hz": None,
                "guardian": {"hpl_m": None if estimate is None else estimate.pop("hpl_m")},
            },
            "vehicle": {}, "shadow": None, "follows": None, "injecting": False,
            "estimate": estimate, "gnss_residual_m": None, "machine": {},
            "targets": self._targets(now_ns), "events": self._events(now_ns),
            "replay": {
                "at_s": self._at_s, "length_s": self._length_s, "playing": self._playing
            },
        }  # fmt: skip

    def _targets(self, now_ns: int) -> list[dict[str, Any]]:
        """Each target's last fix of the last ten seconds."""
        columns = self._tables.targets
        if not columns:
            return []
        times = columns["exposure_time_ns"]
        rows = np.flatnonzero((times <= now_ns) & (times > now_ns - 10_000_000_000))
        newest = {str(columns["target_id"][i]): int(i) for i in rows}
        return [t for name, i in newest.items() if (t := _target(columns, name, i)) is not None]

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

    def _take_picture(self, now_ns: int) -> None:
        """The newest kept picture, with its pose; without the map's view, which is not recorded."""
        camera = self._tables.camera
        known = [p for p in self._pictures if p[0] <= now_ns]
        if not known or camera is None or known[-1][0] == self._shown:
            return
        self._shown, path = known[-1]
        try:
            rgb = read_image(path)
        except (StreamDecodeError, OSError):  # power may have gone while it was written
            return
        if rgb.shape[:2] != (camera.height, camera.width):
            return
        head = {
            "kind": "frame", "exposure_ns": time.monotonic_ns(), "camera": camera.to_dict(),
            "image": [camera.width, camera.height], "estimate": None, "view": None,
        }  # fmt: skip
        self.newest.take(Message(head, rgb.tobytes()))


def _last(columns: Columns, name: str, now_ns: int) -> int | None:
    """The number of the last row up to a time."""
    if not columns:
        return None
    row = int(np.searchsorted(columns[name], now_ns, side="right")) - 1
    return row if row >= 0 else None


def _estimate(columns: Columns, row: int) -> dict[str, Any]:
    def number(name: str) -> float | None:
        value = float(columns[name][row]) if name in columns else float("nan")
        return value if abs(value) < _ABSURD else None  # false for NaN, too

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
        "quality": number("quality"),
        "hpl_m": number("hpl_m"),
        "stages_ms": {
            name: number(f"{name}_ms") for name in ("reference", "extract", "register", "latency")
        },
    }


def _heading_deg(columns: Columns, row: int) -> float | None:
    """Where the picture's top or the camera's axis points, whichever lies flatter."""
    w, x, y, z = (float(columns[k][row]) for k in ("qw", "qx", "qy", "qz"))
    forward = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    up = (-2 * (x * y - w * z), -(1 - 2 * (x * x + z * z)))
    ahead = forward[:2] if abs(forward[2]) < 0.98 else up
    heading = float(np.degrees(np.arctan2(ahead[0], ahead[1])) % 360.0)
    return heading if np.isfinite(heading) else None


def _target(columns: Columns, name: str, row: int) -> dict[str, Any] | None:
    """A target's row; None where a number lacks: browsers read no NaN."""
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
        "pixel": None,
    }
