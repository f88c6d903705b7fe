"""Converts rows of a record's tables to the state document of the web page."""

from __future__ import annotations

from typing import Any

import numpy as np

from companion.offline.tables import Columns

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
