"""Latitudes and longitudes as metres about the first one that was seen."""

from __future__ import annotations

from mavlink_bridge.messages import VisionFix
from mavlink_bridge.vehicle.origin import north_east


class LocalPlace:
    """A flat frame about the first fix."""

    def __init__(self) -> None:
        self._anchor: tuple[float, float] | None = None

    def ned(self, fix: VisionFix) -> tuple[float, float, float]:
        """North, east of the first fix, and down of the ellipsoid; metres."""
        north, east = self.north_east(fix.latitude_deg, fix.longitude_deg)
        return north, east, -fix.height_m

    def north_east(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """North and east of the first fix, metres."""
        if self._anchor is None:
            self._anchor = (latitude_deg, longitude_deg)
        return north_east(*self._anchor, latitude_deg, longitude_deg)
