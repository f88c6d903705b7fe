"""Which map footage needs, where there is none yet."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.errors import FootageError
from companion.recorded.flight import Datum, RecordedFlight

_METRES_PER_DEGREE = 111_320.0
_MARGIN_SHARE, _LEAST_MARGIN_M = 1.5, 100.0  # of the height above ground: what the camera sees
_USUAL_HEIGHT_M = 100.0
_WORKING_PX = 320  # of the image that is registered


@dataclass(frozen=True)
class WantedMap:
    """Bounds in degrees and the ground sampling distance, m, that the footage can use."""

    south: float
    west: float
    north: float
    east: float
    gsd_m: float

    @property
    def sentence(self) -> str:
        """For the user."""
        return (
            f"It needs a map of latitude {self.south:.5f} to {self.north:.5f}, longitude "
            f"{self.west:.5f} to {self.east:.5f}, with pixels of {self.gsd_m:.2f} m or finer and, "
            "if there are buildings or hills, with heights"
        )

    def command(self, out: str) -> str:
        """What fetches one, where open data exist."""
        box = f"{self.west:.5f},{self.south:.5f},{self.east:.5f},{self.north:.5f}"
        return f"companion map fetch --rectangle {box} --out {out}"


def wanted_map(flight: RecordedFlight) -> WantedMap:
    """The footage's surroundings. `FootageError` where no position says where it was taken."""
    positions = [p for f in flight.frames if (p := f.telemetry.position) is not None]
    if not positions:
        raise FootageError(
            f"{flight.name}: neither a map nor a position: give --map, or footage with positions "
            "in it or beside it (--places, --log)"
        )
    heights = [h.value_m for p in positions for h in p.heights if h.datum is Datum.TAKEOFF]
    height = float(np.median(heights)) if heights else _USUAL_HEIGHT_M
    margin = max(_MARGIN_SHARE * height, _LEAST_MARGIN_M)
    latitudes = [p.latitude_deg for p in positions]
    longitudes = [p.longitude_deg for p in positions]
    up = margin / _METRES_PER_DEGREE
    across = up / math.cos(math.radians(latitudes[0]))
    camera = flight.camera.camera
    gsd = height / (camera.fx * _WORKING_PX / camera.width)
    return WantedMap(
        min(latitudes) - up, min(longitudes) - across, max(latitudes) + up,
        max(longitudes) + across, gsd,
    )  # fmt: skip
