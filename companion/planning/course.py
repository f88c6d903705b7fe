"""Geometry of a flown leg: a straight line, a spline as ArduPilot flies it, or a circle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from localizer.geometry.geo import EARTH_RADIUS_M
from localizer.geometry.pose import Array
from mavlink_bridge.mission.items import LoiterCircle

_PIECES = 64  # of a spline or a circle
# The vectors at both ends are shortened to so many times the distance between them
# (SplineCurve::set_origin_and_destination).
_LONGEST = 4.0


@dataclass(frozen=True)
class Course:
    """Path of a leg. points: (N, 3), world metres; leaves: (3,) direction and strength at its end,
    zero for a stop; nose_deg: heading of the vehicle, clockwise from the path.
    """

    points: Array
    leaves: Array
    nose_deg: float = 0.0
    is_circle: bool = False

    @property
    def length_m(self) -> float:
        """Horizontal length, m."""
        return float(self._steps().sum())

    def at(self, share: float) -> tuple[Array, float]:
        """Position (3,), world metres, and direction of the path, degrees clockwise from the map's
        north, after a share (0 to 1) of the length.
        """
        steps = self._steps()
        done = np.concatenate([[0.0], np.cumsum(steps)])
        way = share * done[-1]
        k = int(np.clip(np.searchsorted(done, way, side="right") - 1, 0, len(steps) - 1))
        start, end = self.points[k], self.points[k + 1]
        east, north, _ = end - start
        part = (way - done[k]) / max(steps[k], 1e-9)
        # As high above the Earth as between the ends: a chord lies below.
        bulge = 0.5 * part * (1.0 - part) * (east * east + north * north) / EARTH_RADIUS_M
        position = start + part * (end - start) + (0.0, 0.0, bulge)
        return position, float(np.degrees(np.arctan2(east, north)) % 360.0)

    def _steps(self) -> Array:
        return np.asarray(np.hypot(*np.diff(self.points, axis=0)[:, :2].T))


def straight(start: Array, end: Array) -> Course:
    """A straight course between two positions (3,), world metres."""
    return Course(np.stack([start, end]), end - start)


def spline(
    start: Array, end: Array, arrives: Array, after: Array | None, *, curved_on: bool
) -> Course:
    """A spline leg between two positions (3,), world metres. arrives: `leaves` (3,) of the course
    before; after: next position, None for a stop; curved_on: whether the next leg is a spline.
    """
    leaves = np.zeros(3)
    if after is not None:
        leaves = after - start if curved_on else after - end
    longest = _LONGEST * float(np.linalg.norm(end - start))
    strength = float(np.linalg.norm(arrives) + np.linalg.norm(leaves))
    scale = min(longest / strength, 1.0) if strength > 0 else 1.0
    t = np.linspace(0.0, 1.0, _PIECES + 1)[:, None]
    points = (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * scale * arrives
        + (3 * t**2 - 2 * t**3) * end
        + (t**3 - t**2) * scale * leaves
    )
    return Course(points, leaves)


def circled(centre: Array, arrives: Array, circle: LoiterCircle) -> Course:
    """One circle about a position (3,), world metres, from the point where a vehicle flying in
    direction `arrives` (3,) meets it; counter-clockwise if the circle's radius is negative.
    """
    begin = np.arctan2(-arrives[1], -arrives[0])
    turned = begin - np.sign(circle.radius_m) * np.linspace(0.0, 2.0 * np.pi, _PIECES + 1)
    out = np.stack([np.cos(turned), np.sin(turned), np.zeros_like(turned)], axis=-1)
    nose_deg = float(np.sign(circle.radius_m)) * 90.0 if circle.inward else 0.0
    return Course(centre + abs(circle.radius_m) * out, np.zeros(3), nose_deg, is_circle=True)
