"""Plausibility limits for target positions: on the map, at the measured depth, without jumps.

Through a hole in the map under a car, its rays hit the ground hundreds of metres behind, with a
small covariance. The target's previous position and the depth of neighbouring rays show the error.

Errors common to all targets of a flight, of map, pose and boresight, are a consider state
(Schmidt): part of every target's covariance that no observation reduces, so that many observations
do not claim more than the map's accuracy.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from localizer.geometry.pose import Array
from localizer.targets.locate import RayCaster
from localizer.types import TargetFix, TargetSurface

_SIGMAS = 3.0
_FASTEST_MPS = 60.0
_LEAP_NS = 3_000_000_000  # a leap is believed once sightings have agreed on it for so long
_LEAP_GAP_NS = 1_000_000_000  # and none was missing for so long
_OFF_SURFACE_M = 25.0  # between a place and the map: a bridge, a tree, a roof's edge
_DEPTH_M = 3.0
_ABOUT_M = 25.0  # around a place: what the map shows there tells a hole from a street
_HOLE, _HOLE_M = 1.5, 20.0  # so much farther than all of it: no courtyard is, from a flying height
_NEAR_M = 2.5
_RING = np.array([[np.cos(a), np.sin(a)] for a in np.arange(8) * np.pi / 4])
_ASIDE = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=np.float64)


class RefusalReason(enum.Enum):
    """Why an observation gives no position."""

    NO_MAP = "no map under it"
    TOO_FAR = "{metres:.0f} m away"
    HOLE = "a hole in the map"
    UNCERTAIN = "known to {metres:.0f} m only"
    NOT_UNDER_PIXEL = "not under its pixel"
    OFF_MAP = "no map at its place"
    OTHER_DEPTH = "not at the seen depth"
    ELSEWHERE = "elsewhere than before"
    MOVED = "moved {metres:.0f} m"
    UNCONFIRMED = "not confirmed yet"


@dataclass(frozen=True)
class TargetRefusal:
    """Why a position is refused. metres: distance (TOO_FAR, MOVED) or sigma (UNCERTAIN)."""

    reason: RefusalReason
    metres: float = 0.0

    def __str__(self) -> str:
        return self.reason.value.format(metres=self.metres)


@dataclass
class _Leap:
    """Another position that was observed repeatedly since `since_ns`."""

    since_ns: int
    newest: TargetFix


class LastPosition:
    """Last reported position of a target. Not thread-safe. confirm_ns: time over which its first
    observations must agree, so that holes in the first frames' depth do not matter.
    """

    def __init__(self, confirm_ns: int = 0) -> None:
        self._confirm_ns = confirm_ns
        self.fix: TargetFix | None = None
        self._leap: _Leap | None = None
        self._begun_ns = 0

    def check(self, fix: TargetFix, *, moves: bool) -> TargetRefusal | None:
        """Why a position is rejected; None if it is accepted and becomes the last position. moves:
        whether the target may have moved since, at up to 60 m/s; otherwise it may be apart by three
        sigmas only. Call with every position, in the order of time.

        A detector may give the same name to another object. The new position is accepted once it
        was observed for as long as the old one, at most 3 s.
        """
        last, time_ns = self.fix, fix.exposure_time_ns
        if last is None:
            return self._first(fix)
        if _reachable(last, fix, moves=moves):
            self.fix, self._leap = fix, None
            return None
        leap = self._leap
        follows = (
            leap is not None
            and time_ns - leap.newest.exposure_time_ns <= _LEAP_GAP_NS
            and _reachable(leap.newest, fix, moves=True)
        )
        if leap is None or not follows:
            leap = _Leap(time_ns, fix)
        self._leap = _Leap(leap.since_ns, fix)
        if time_ns - leap.since_ns >= min(_LEAP_NS, last.exposure_time_ns - self._begun_ns):
            self.fix, self._leap, self._begun_ns = fix, None, leap.since_ns
            return None
        moved = float(np.linalg.norm(fix.position_world - last.position_world))
        return TargetRefusal(RefusalReason.MOVED, moved)

    def _first(self, fix: TargetFix) -> TargetRefusal | None:
        """Check before the first report: the position is accepted once observations have agreed."""
        begun, time_ns = self._leap, fix.exposure_time_ns
        if begun is None:
            begun = _Leap(time_ns, fix)
        elif not _reachable(
            begun.newest, fix, moves=time_ns - begun.newest.exposure_time_ns <= _LEAP_NS
        ):
            return TargetRefusal(RefusalReason.ELSEWHERE)
        self._leap = _Leap(begun.since_ns, fix)
        if time_ns - begun.since_ns < self._confirm_ns:
            return TargetRefusal(RefusalReason.UNCONFIRMED)
        self.fix, self._leap, self._begun_ns = fix, None, begun.since_ns
        return None


def is_near_map_hole(eye: Array, direction: Array, distance: float, cast: RayCaster) -> bool:
    """Whether a ray passes through or near a hole or the edge of the map, so that it hits ground
    behind. eye, direction: (3,); distance: metres to its hit.

    A ray in a hole hits nothing, or hits at a much larger distance than its neighbours.
    """
    sideways = np.linalg.svd(direction[None, :])[2][1:]
    rings = np.concatenate([_NEAR_M * _RING, _ABOUT_M * _RING])
    rays = direction + rings / distance @ sideways
    found = cast(eye, rays / np.linalg.norm(rays, axis=1)[:, None]).distances
    near, about = np.split(found, 2)
    if not np.isfinite(near).all() or not np.isfinite(about).any():
        return True
    farthest = float(np.nanmax(about))
    return distance > max(_HOLE * farthest, farthest + _HOLE_M)


def is_on_map(fix: TargetFix, cast: RayCaster) -> bool:
    """Whether the map has a surface at about the position's height, within its error."""
    P = fix.covariance
    aside = max(1.0, 2.0 * float(np.sqrt(P[0, 0] + P[1, 1])))
    reach = _OFF_SURFACE_M + _SIGMAS * float(np.sqrt(P[2, 2]))
    down = np.array([[0.0, 0.0, -1.0]])
    for offset in _ASIDE:
        above = fix.position_world + aside * offset + np.array([0.0, 0.0, reach])
        distance = float(cast(above, down).distances[0])
        if np.isfinite(distance) and distance <= 2.0 * reach:
            return True
    return False


def is_at_seen_depth(
    fix: TargetFix, eye: Array, direction: Array, surfaces: tuple[TargetSurface, ...]
) -> bool:
    """Whether a position is at the depth of one of the surfaces that the frame's rays hit, within
    both errors. eye, direction: (3,) of the pixel's ray.
    """
    along = float((fix.position_world - eye) @ direction)
    own = float(np.sqrt(direction @ fix.covariance @ direction))
    for surface in surfaces:
        off = abs(along - float((surface.position - eye) @ direction))
        sigma = float(np.sqrt(direction @ surface.covariance @ direction))
        if off <= _DEPTH_M + _SIGMAS * (own + sigma):
            return True
    return False


def _reachable(a: TargetFix, b: TargetFix, *, moves: bool) -> bool:
    """Whether both may be one target: apart by no more than their errors and a vehicle's way."""
    moved = float(np.linalg.norm(b.position_world - a.position_world))
    both = sum(float(np.sqrt(np.trace(fix.covariance))) for fix in (a, b))
    speed = _FASTEST_MPS if moves or b.velocity is not None else 0.0
    elapsed_s = abs(b.exposure_time_ns - a.exposure_time_ns) * 1e-9
    return moved <= _SIGMAS * both + speed * elapsed_s


@dataclass(frozen=True)
class SharedBias:
    """Sigmas of the common error: metres along each axis, and radians as seen from the camera."""

    sigma_m: float = 0.2
    sigma_rad: float = 0.0005

    def covariance(self, offset: Array) -> Array:
        """(3, 3) m², world axes, of a target at `offset` (3,) from the camera."""
        distance = float(np.linalg.norm(offset))
        d = offset / max(distance, 1e-6)
        across = np.eye(3) - np.outer(d, d)
        shared: Array = self.sigma_m**2 * np.eye(3) + (self.sigma_rad * distance) ** 2 * across
        return shared
