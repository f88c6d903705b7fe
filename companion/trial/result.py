"""Results of a trial, its figures and its verdict, and the map that footage needs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.errors import FootageError
from companion.integrity_monitor.config import ProtectionConfig
from companion.integrity_monitor.protection import budget
from companion.recorded.flight import Datum, RecordedFlight, Telemetry
from companion.trial.estimate import LEAST_FRAMES, Estimated
from companion.trial.localize import Localized, horizontal_m
from companion.trial.priors import FramePrior
from localizer.geometry.pose import Array

WORKS, PARTLY, NOT, UNKNOWN = (
    "works", "works partly", "does not work", "cannot be judged"
)  # fmt: skip
FOUND, ELSEWHERE = "found", "elsewhere"
_GOOD_SHARE, _SOME_SHARE = 0.8, 0.3
_SAME_PLACE_SIGMAS, _LEAST_SAME_M = 4.0, 10.0
_STILL_MPS = (0.0, 0.0)  # of photos: time stamps are no part of their positions' error


@dataclass(frozen=True)
class Trial:
    """All results. priors: corrected; first: localized with the telemetry as recorded; second: with
    estimated corrections; searched: without positions, by frame number; estimated: None if it
    failed; reasons: of the frames that failed in `best`, by frame number.
    """

    flight: RecordedFlight
    priors: tuple[FramePrior, ...]
    first: tuple[Localized, ...]
    second: tuple[Localized, ...]
    searched: dict[int, Localized]
    estimated: Estimated | None
    reasons: dict[int, str]
    notes: tuple[str, ...]

    @property
    def accepted_count(self) -> int:
        """Number of frames localized from telemetry, after the correction."""
        return sum(one.accepted for one in self.second)

    @property
    def best(self) -> tuple[Localized, ...]:
        """Each frame's result from telemetry; an accepted one of the search if that failed."""
        return tuple(
            one if one.accepted or not found.accepted else found
            for k, one in enumerate(self.second)
            for found in (self.searched.get(k, one),)
        )

    def errors_m(self) -> Array:
        """(F,) horizontal distance of accepted positions from the recorded ones, m, after
        correction by the estimated map offset; NaN if either is missing.
        """
        found = np.full(len(self.best), np.nan)
        for k, (one, prior) in enumerate(zip(self.best, self.priors, strict=True)):
            if one.accepted and one.pose is not None and prior.pose is not None:
                found[k] = horizontal_m(one.pose, prior.pose)
        return found

    def levels_m(self) -> Array:
        """(F,) horizontal protection level of accepted positions, m; NaN for others."""
        config = ProtectionConfig()
        levels = np.full(len(self.best), np.nan)
        for k, (one, prior) in enumerate(zip(self.best, self.priors, strict=True)):
            if one.accepted and one.covariance is not None:
                P = one.covariance
                sigma = float(np.sqrt(max(np.linalg.eigvalsh(P[:2, :2])[-1], 0.0)))
                sigmas = (sigma, float(np.sqrt(max(P[2, 2], 0.0))))
                levels[k] = budget(sigmas, prior.clearance_m, _STILL_MPS, config)[0]
        return levels

    def search_outcome(self) -> tuple[int, int, int]:
        """Numbers of frames that were searched without position, found there, and found elsewhere:
        far from both the recorded and the telemetry-based position.
        """
        results = list(self.search_results().values())
        return len(results), results.count(FOUND), results.count(ELSEWHERE)

    def search_results(self) -> dict[int, str]:
        """Result of each search without position, by frame: found, elsewhere or "not found"."""
        results = dict.fromkeys(self.searched, "not found")
        for k, one in self.searched.items():
            if not one.accepted or one.pose is None:
                continue
            second, prior = self.second[k], self.priors[k]
            limit_m = max(_LEAST_SAME_M, _SAME_PLACE_SIGMAS * prior.sigma_m)
            known = [(second.pose, _LEAST_SAME_M)] if second.accepted else []
            away = [
                horizontal_m(one.pose, pose) <= limit
                for pose, limit in (*known, (prior.pose, limit_m))
                if pose is not None
            ]
            results[k] = FOUND if any(away) or not away else ELSEWHERE  # found if nobody objects
        return results


@dataclass(frozen=True)
class TrialVerdict:
    """kind: WORKS, PARTLY, NOT or UNKNOWN; sentence: the verdict for the user."""

    kind: str
    sentence: str

    @property
    def exit_code(self) -> int:
        """Exit code of the command: 0 for WORKS, otherwise 1."""
        return 0 if self.kind == WORKS else 1


def trial_verdict(trial: Trial) -> TrialVerdict:
    """The verdict: its kind, which sets the exit code, and a sentence with the figures.

    WORKS: 80 % of the frames are localized, no search finds a wrong place, and the median
    difference from GNSS, if known, is at most `spread_limit_m`. PARTLY: 30 % are localized, but one
    of these conditions fails. NOT: fewer than 30 %. UNKNOWN: fewer than `LEAST_FRAMES` frames.
    """
    count = len(trial.best)
    localized = sum(one.accepted for one in trial.best)
    searched, right, wrong = trial.search_outcome()
    errors = trial.errors_m()
    known = errors[np.isfinite(errors)]
    kind = _kind(localized / max(count, 1), trial, known)
    parts = [f"{localized} of {count} frames are localized"]
    if len(known):
        parts[0] += f", {np.median(known):.1f} m from GNSS in the median"
        if trial.estimated is not None and trial.estimated.has_shift:
            offset = float(np.hypot(*trial.estimated.shift_m[:2]))
            parts[0] += f" after a horizontal map offset of {offset:.1f} m"
    if searched:
        found = f"without positions {right} of {searched} are found"
        parts.append(found + (f" and {wrong} at a wrong place" if wrong else ""))
    if kind == UNKNOWN:
        parts.append(f"give {LEAST_FRAMES} or more, so that a wrong angle or focal length shows")
    return TrialVerdict(kind, f"Vision {kind} here: {'; '.join(parts)}{main_reason(trial)}.")


def _kind(share: float, trial: Trial, known: Array) -> str:
    if len(trial.best) < LEAST_FRAMES:
        return UNKNOWN
    if share < _SOME_SHARE:
        return NOT
    wrong = trial.search_outcome()[2]
    spread = spread_limit_m(trial)
    scattered = len(known) > 0 and float(np.median(known)) > spread
    return PARTLY if share < _GOOD_SHARE or wrong or scattered else WORKS


def spread_limit_m(trial: Trial) -> float:
    """Limit of the median distance from GNSS, m: root sum square of 3 m and two sigmas of GNSS."""
    sigmas = [p.sigma_m for p in trial.priors if p.pose is not None]
    own = float(np.median(sigmas)) if sigmas else 0.0
    return float(np.hypot(2.0 * own, 3.0))


def main_reason(trial: Trial) -> str:
    """The most frequent reason why frames failed, as the end of a sentence ("; likely reason ...");
    "" without failures.
    """
    if not trial.reasons:
        return ""
    heads = [text.split(":", maxsplit=1)[0] for text in trial.reasons.values()]
    return f"; likely reason of most failures: {max(sorted(set(heads)), key=heads.count)}"


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
