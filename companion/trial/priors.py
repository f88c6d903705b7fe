"""Pose priors with sigmas from telemetry, over a map.

A flight may record several heights of different accuracy. The map shows which are usable: a height
that puts cameras below the ground has another datum, or was not measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from companion.errors import FootageError
from companion.planning.way import MapHeights
from companion.recorded.flight import (
    Datum,
    Height,
    RecordedFlight,
    RecordedFrame,
    RecordedPosition,
)
from companion.recorded.photo_tags import looking_down
from localizer.errors import MapCacheError
from localizer.geometry.geo import Geodetic, LocalFrame
from localizer.geometry.pose import Array, Pose
from localizer.map.cache.cache import TileCache
from localizer.types import PosePrior

_LEAST_CLEARANCE_M, _MOST_CLEARANCE_M = 3.0, 10_000.0
_IMPOSSIBLE_SHARE = 0.1  # of the frames: beyond it a datum's heights are not used at all
_UNKNOWN_CLEARANCE_M = (15.0, 150.0)  # of small drones: 120 m is the usual limit, over relief
_DATUM_M = 10.0  # between the heights of two datums: more is worth a look before a flight
_FOOT_M = 0.3048
_CLIMB_M = 100.0  # between take-off and photos; less is no sign of feet: on a hillside by the sea
_KNOWN_SHARE = 0.35  # of the height above ground: a wider sigma is as good as none
_FAR_M = 10_000.0  # beyond the map's edge: no camera sees it from there


@dataclass(frozen=True)
class FramePrior:
    """Prior of one frame, in map coordinates (east, north, up; m). pose: None without a recorded
    position; rotation: (3, 3) world from camera; sigma_m: horizontal; height_m: z, an unknown one
    the middle of its range with half the range as sigma; measured: the tilt was; over_map: the
    position is; clearance_m: height above the map's ground; was_searched: from a search instead of
    telemetry.
    """

    pose: Pose | None
    rotation: Array
    sigma_m: float
    height_m: float
    height_sigma_m: float
    height_known: bool
    tilt_sigma_deg: float
    heading_sigma_deg: float | None
    measured: bool
    over_map: bool
    clearance_m: float
    was_searched: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether a registration can start from this prior without a search."""
        return self.pose is not None and self.height_known and self.heading_sigma_deg is not None

    def pose_prior(self, time_ns: int) -> PosePrior:
        """As a `PosePrior` at this time (ns); ValueError without position or heading."""
        if self.pose is None or self.heading_sigma_deg is None:
            raise ValueError("the prior is not complete")
        tilt, heading = np.radians([self.tilt_sigma_deg, self.heading_sigma_deg])
        sigma = [self.sigma_m, self.sigma_m, self.height_sigma_m, tilt, tilt, heading]
        return PosePrior(self.pose, np.diag(np.square(sigma)), time_ns)


@dataclass(frozen=True)
class Correction:
    """Estimated errors of the telemetry. mount: (3, 3) rotation, recorded from true camera axes;
    shift: (3,) m east, north, up, map minus GNSS; tilt_sigma_deg: error that remains.
    """

    mount: Array
    shift: Array
    tilt_sigma_deg: float

    def applied(self, prior: FramePrior) -> FramePrior:
        """A copy of the prior with corrected rotation, position and height, and tilt sigma."""
        rotation = prior.rotation @ self.mount
        pose = prior.pose
        if pose is not None:
            pose = Pose(rotation, pose.translation + self.shift)
        return replace(
            prior, pose=pose, rotation=rotation, height_m=prior.height_m + float(self.shift[2]),
            tilt_sigma_deg=min(prior.tilt_sigma_deg, self.tilt_sigma_deg),
        )  # fmt: skip


@dataclass(frozen=True)
class FlightPriors:
    """Priors of all frames in order. datum: of the recorded heights used, None if none is usable;
    notes: decisions and reasons, for the user.
    """

    priors: tuple[FramePrior, ...]
    datum: Datum | None
    notes: tuple[str, ...]


def priors_of(flight: RecordedFlight, cache: TileCache) -> FlightPriors:
    """Priors of a flight's frames over this map. `FootageError` if all lie far from it."""
    _check_near(flight, cache)
    ground, frame = MapHeights(cache), cache.frame
    geoid_m = cache.manifest.geoid_separation_m
    places = [_enu(f.telemetry.position, frame) for f in flight.frames]
    below = [None if p is None else _height_below(p, ground) for p in places]
    known = [z for z in below if z is not None]
    notes: list[str] = []
    heights: list[Height | None] = [None] * len(places)
    datum: Datum | None = None
    if known:
        levels = _world_heights(flight.frames, frame, geoid_m, known[0], float(np.std(known)))
        datum = _usable_datum(levels, below, notes)
        notes += _feet_note(levels, known[0] + frame.origin.height_m, geoid_m)
        if datum is not None:
            heights = [by_datum.get(datum) for by_datum in levels]
    usual = float(np.median(known)) if known else float(cache.index.box_min[:, 2].min())
    made = [
        _prior(f, p, z, h, usual, frame)
        for f, p, z, h in zip(flight.frames, places, below, heights, strict=True)
    ]
    notes += _assumptions(flight.frames, made)
    return FlightPriors(tuple(made), datum, tuple(notes))


def _check_near(flight: RecordedFlight, cache: TileCache) -> None:
    """`FootageError`, with the likely mistake, if all positions lie far from the map."""
    told = [f.telemetry.position for f in flight.frames if f.telemetry.position is not None]
    places = np.array([(p.latitude_deg, p.longitude_deg) for p in told]).reshape(-1, 2)
    low, high = cache.index.box_min[:, :2].min(axis=0), cache.index.box_max[:, :2].max(axis=0)
    reach_m = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))) + _FAR_M

    def nearest_m(places: Array) -> float:
        enu = [cache.frame.enu_from_geodetic(lat, lon, 0.0) for lat, lon in places]
        return float(np.linalg.norm(enu, axis=1).min())

    if not told or nearest_m(places) <= reach_m:
        return
    slips = {
        "latitude and longitude are swapped": places[:, ::-1],
        "the longitude's sign is wrong": places * [1, -1],
        "the latitude's sign is wrong": places * [-1, 1],
    }
    fits = [what for what, p in slips.items() if np.abs(p[:, 0]).max() <= 90.0
            and nearest_m(p) <= reach_m]  # fmt: skip
    origin = cache.frame.origin
    raise FootageError(
        f"{flight.name}: its positions, the first latitude {places[0, 0]:.4f}, longitude "
        f"{places[0, 1]:.4f}, lie {nearest_m(places) * 1e-3:,.0f} km from the map, which is at "
        f"{origin.latitude_deg:.4f}, {origin.longitude_deg:.4f}: "
        + (fits[0] if fits else "give the map of that place, which `try` without --map names")
    )


def _enu(position: RecordedPosition | None, frame: LocalFrame) -> Array | None:
    if position is None:
        return None
    return np.asarray(
        frame.enu_from_geodetic(
            position.latitude_deg, position.longitude_deg, frame.origin.height_m
        )
    )


def _height_below(place: Array, ground: MapHeights) -> float | None:
    try:
        return ground.height_m(float(place[0]), float(place[1]))
    except MapCacheError:
        return None  # told by `map verify`


def _world_heights(
    frames: Sequence[RecordedFrame], frame: LocalFrame, geoid_m: float, takeoff_m: float,
    relief_m: float,
) -> list[dict[Datum, Height]]:  # fmt: skip
    """Each frame's heights as world z, by datum. takeoff_m: world z of the ground below the first
    frame, which stands for the take-off place.
    """
    levels = []
    for one in frames:
        position = one.telemetry.position
        found: dict[Datum, Height] = {}
        for height in position.heights if position is not None else ():
            if height.datum is Datum.TAKEOFF:
                z, sigma = takeoff_m + height.value_m, math.hypot(height.sigma_m, relief_m)
            else:
                lift = geoid_m if height.datum is Datum.AMSL else 0.0
                z, sigma = height.value_m + lift - frame.origin.height_m, height.sigma_m
            found[height.datum] = Height(z, height.datum, sigma)
        levels.append(found)
    return levels


def _usable_datum(
    levels: Sequence[dict[Datum, Height]], below: Sequence[float | None], notes: list[str]
) -> Datum | None:
    """Of the datums possible over this map the one with the smallest sigma; adds notes. below:
    world z of the ground below each frame.
    """
    sigmas: dict[Datum, float] = {}
    clearances: dict[Datum, float] = {}
    for datum in Datum:
        rows = [
            (by_datum[datum], z)
            for by_datum, z in zip(levels, below, strict=True)
            if datum in by_datum and z is not None
        ]
        if len(rows) < max(1, len(levels) // 2):
            continue
        above = np.array([h.value_m - z for h, z in rows])
        wrong = (above < _LEAST_CLEARANCE_M) | (above > _MOST_CLEARANCE_M)
        if wrong.mean() > _IMPOSSIBLE_SHARE:
            notes.append(
                f"heights above the {datum.value} cannot be true over this map: they put "
                f"{int(wrong.sum())} of {len(rows)} frames {above.min():.0f} to "
                f"{above.max():.0f} m above its ground; they are not used (heights above the "
                "take-off belong into a column relative_alt_m)"
            )
            continue
        sigmas[datum] = float(np.median([h.sigma_m for h, _ in rows]))
        clearances[datum] = float(np.median(above))
    if not sigmas:
        low, high = _UNKNOWN_CLEARANCE_M
        notes.append(f"no height is known: {low:.0f} to {high:.0f} m above the ground are tried")
        return None
    best = min(sigmas, key=lambda d: sigmas[d])
    for datum, clearance in clearances.items():
        apart = clearance - clearances[best]
        if abs(apart) > _DATUM_M:
            notes.append(
                f"heights above the {datum.value} are {apart:+.0f} m from those above the "
                f"{best.value}, which are used: check the map's height datum before a flight"
            )
    return best


def _feet_note(
    levels: Sequence[dict[Datum, Height]], takeoff_m: float, geoid_m: float
) -> list[str]:
    """A note if the map's heights seem to be in feet, otherwise []. Absolute minus relative height
    is the take-off's height; then it is 0.3 of the map's.

    takeoff_m: the map's ground at the take-off, above the ellipsoid.
    """
    for datum, ground in ((Datum.ELLIPSOID, takeoff_m), (Datum.AMSL, takeoff_m - geoid_m)):
        both = [(told[datum], told[Datum.TAKEOFF]) for told in levels
                if {datum, Datum.TAKEOFF} <= told.keys()]  # fmt: skip
        if not both:
            continue
        photos = ground + float(np.median([a.value_m - b.value_m for a, b in both]))
        sigma = float(np.median([math.hypot(a.sigma_m, b.sigma_m) for a, b in both]))
        if (
            abs(photos - ground) > max(3.0 * sigma, _CLIMB_M)
            and abs(photos - _FOOT_M * ground) < 2.0 * sigma
        ):
            return [
                f"the map's ground is {ground:.0f} m above the {datum.value}, by the photos' "
                f"heights {photos:.0f} m: are its heights in feet? Build it with --height-unit ft"
            ]
    return []


def _prior(
    one: RecordedFrame, place: Array | None, ground_m: float | None, height: Height | None,
    usual_m: float, frame: LocalFrame,
) -> FramePrior:  # fmt: skip
    telemetry = one.telemetry
    view = telemetry.view or looking_down(telemetry.course_deg)
    told = telemetry.position
    at = frame.origin if told is None else Geodetic(told.latitude_deg, told.longitude_deg, 0.0)
    rotation = np.asarray(frame.ned_from_enu(at).T @ view.ned_from_camera)
    base = ground_m if ground_m is not None else usual_m
    low, high = (base + c for c in _UNKNOWN_CLEARANCE_M)
    z, sigma, is_known = 0.5 * (low + high), 0.5 * (high - low), False
    if height is not None:
        z, sigma = height.value_m, height.sigma_m
        is_known = sigma < _KNOWN_SHARE * (z - base)
    pose = None if place is None else Pose(rotation, np.array([place[0], place[1], z]))
    sigma_m = told.sigma_m if told is not None else math.inf
    return FramePrior(
        pose, rotation, sigma_m, z, sigma, is_known, view.tilt_sigma_deg, view.heading_sigma_deg,
        view.measured, ground_m is not None, max(z - base, 1.0),
    )  # fmt: skip


def _assumptions(frames: Sequence[RecordedFrame], priors: Sequence[FramePrior]) -> list[str]:
    notes = []
    assumed = sum(not p.measured for p in priors)
    if assumed:
        notes.append(
            f"the camera's tilt is not measured in {assumed} of {len(priors)} frames: taken as "
            f"straight down, {priors[0].tilt_sigma_deg:.0f} degrees unsure"
        )
    for what, unknown in (
        ("heading", sum(p.heading_sigma_deg is None for p in priors)),
        ("height", sum(p.pose is not None and not p.height_known for p in priors)),
    ):
        if unknown:
            notes.append(f"no usable {what} in {unknown} of {len(priors)} frames: searched")
    beside = sum(f.telemetry.position is not None for f in frames) - sum(p.over_map for p in priors)
    if beside:
        notes.append(f"{beside} frames were taken beside the map")
    return notes
