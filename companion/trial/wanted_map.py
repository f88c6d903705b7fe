"""Describes the map that footage needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.errors import FootageError
from companion.recorded.flight import Datum, RecordedFlight, Telemetry

_METRES_PER_DEGREE = 111_320.0
_MARGIN_SHARE, _LEAST_MARGIN_M = 1.5, 100.0  # of the height above ground: what the camera sees
_USUAL_HEIGHT_M = 100.0
_HIGHEST_M = 500.0  # above it the margin does not grow: what is seen lies on the axis
_STEEPEST_DEG = 75.0  # of the axis from straight down; beyond it the horizon is in view
_WORKING_PX = 320  # of the image that is registered


@dataclass(frozen=True)
class WantedMap:
    """Bounds in degrees (WGS84), and the coarsest useful size of a map pixel on the ground, m."""

    south: float
    west: float
    north: float
    east: float
    gsd_m: float

    @property
    def sentence(self) -> str:
        """Sentence for the user, without full stop: "It needs a map of ..." (It: the footage)."""
        return (
            f"It needs a map of latitude {self.south:.5f} to {self.north:.5f}, longitude "
            f"{self.west:.5f} to {self.east:.5f}, with pixels of {self.gsd_m:.2g} m or finer and, "
            "if there are buildings or hills, with heights"
        )

    def command(self, out: str) -> str:
        """Command that fetches imagery of these bounds from open data into the folder `out`."""
        box = f"{self.west:.5f},{self.south:.5f},{self.east:.5f},{self.north:.5f}"
        return f"companion map fetch --rectangle {box} --out {out}"


def wanted_map(flight: RecordedFlight) -> WantedMap:
    """The map that the footage needs. `FootageError` if no frame has a position."""
    recorded = [f.telemetry for f in flight.frames if f.telemetry.position is not None]
    if not recorded:
        raise FootageError(
            f"{flight.name}: neither a map nor a position: give --map, or footage with positions "
            "in it or beside it (--places, --log)"
        )
    height = _height_m(recorded)
    points = np.array([point for one in recorded for point in _viewed_points(one, height)])
    south, west = points.min(axis=0)
    north, east = points.max(axis=0)
    up = max(_MARGIN_SHARE * min(height, _HIGHEST_M), _LEAST_MARGIN_M) / _METRES_PER_DEGREE
    across = up / math.cos(math.radians(south))
    camera = flight.camera.camera
    slant = height / math.cos(math.radians(_tilt_deg(recorded[0])))
    gsd = slant / (camera.fx * _WORKING_PX / camera.width)
    return WantedMap(south - up, west - across, north + up, east + across, gsd)


def flat_map_advice(flight: RecordedFlight) -> str:
    """Advice to build a flat map at the take-off's height; "" if the height is unknown."""
    places = [f.telemetry.position for f in flight.frames if f.telemetry.position is not None]
    for datum, option, above in (
        (Datum.AMSL, "amsl", "the sea"), (Datum.ELLIPSOID, "ellipsoidal", "the ellipsoid")
    ):  # fmt: skip
        both = [(p.height_m(datum), p.height_m(Datum.TAKEOFF)) for p in places]
        ground = [a - b for a, b in both if a is not None and b is not None]
        if ground:
            ground_m = float(np.median(ground))
            return (
                f"By the tags the ground at the take-off is {ground_m:.0f} m above {above}. Over "
                "even ground an orthophoto alone gives a first answer: companion map build "
                f"ORTHO.tif --flat-ground {ground_m:.0f} --vertical-datum {option} --out area"
            )
    return ""


def _height_m(recorded: Sequence[Telemetry]) -> float:
    """Height above ground without a map: median above take-off, else above the sea, else 100 m."""
    for datum in (Datum.TAKEOFF, Datum.AMSL):
        told = [one.position.height_m(datum) for one in recorded if one.position is not None]
        heights = [height for height in told if height is not None]
        if heights:
            return max(float(np.median(heights)), _USUAL_HEIGHT_M / 10)
    return _USUAL_HEIGHT_M


def _tilt_deg(one: Telemetry) -> float:
    return 0.0 if one.view is None else min(one.view.nadir_angle_deg, _STEEPEST_DEG)


def _viewed_points(one: Telemetry, height_m: float) -> list[tuple[float, float]]:
    """(latitude, longitude) below the camera and where the optical axis meets flat ground."""
    position = one.position
    if position is None:
        return []
    at = (position.latitude_deg, position.longitude_deg)
    if one.view is None:
        return [at]
    north, east, _ = one.view.ned_from_camera[:, 2]
    level = math.hypot(north, east) or 1.0
    reach = height_m * math.tan(math.radians(_tilt_deg(one))) / _METRES_PER_DEGREE
    shrink = math.cos(math.radians(at[0]))
    return [at, (at[0] + reach * north / level, at[1] + reach * east / level / shrink)]
